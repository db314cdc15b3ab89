import { headMovements } from "./challenge.js";
import { field, folded, h, oneIn, percent } from "./dom.js";
import { photoForm } from "./form.js";
import { call, form, levels, moves, session, subjectPath } from "./service.js";
import { DEMO, livenessWords } from "./words.js";

const REASONS = {
  match: "The face matches the enrolled person.",
  no_match: "No match: another person, poor photos, an unknown id, or a holder key that is wrong or missing.",
};
const HOW = {
  drawn: "Choose the person, then a cartoon photo.",
  movements: "You will be asked to move your head.",
  photos: "With the camera, one click takes three photos and sends them.",
};
// What to do differently depends on what was asked for.
const NOT_LIVE = {
  movements: "Nothing shows that a living person is before the camera. Follow each movement as it is asked for, in good light.",
  photos: "Nothing shows that a living person is before the camera. Take new photos of the face itself, in good light.",
};

export function verifyView(id) {
  const level = h(
    "select",
    { onchange: () => view.refresh() },
    levels().map(({ name, target_fmr: rate }) =>
      h(
        "option",
        { value: name, selected: name === session.contract.default_level },
        rate ? `${name}: ${oneIn(rate)} strangers` : name,
      ),
    ),
  );
  const kind = () => (moves() ? "movements" : "photos");

  async function send(name, { photos, ...fields }, say) {
    say("Comparing…");
    const body = form("images", photos, { level: level.value, ...fields });
    return call("POST", `${subjectPath(name)}/verify`, { body });
  }

  const view = photoForm(id, {
    action: "verify",
    title: "Verify",
    lead: "Is this the person who is enrolled under this id?",
    beside: field("Level", level),
    empty: () => `The decision appears here. ${HOW[DEMO ? "drawn" : kind()]}`,
    most: 5,
    replaces: true,
    level: () => level.value,
    movements: headMovements(),
    moving: moves,
    verb: "Verify",
    send,
    token: () => ({ level: level.value }),
    show: (name, answer) => decision(name, answer, kind()),
  });
  return view;
}

function decision(id, answer, kind) {
  const accepted = answer.decision === "accept";
  const live = livenessWords(answer);
  return h(
    "div",
    { class: `verdict ${accepted ? "accept" : "reject"}` },
    h("p", { class: "verdict-word" }, accepted ? "✓ Accepted" : "✕ Rejected"),
    h("p", {}, REASONS[answer.reason] ?? NOT_LIVE[kind], answer.advice ? ` ${answer.advice}` : ""),
    answer.distance === undefined
      ? null
      : h("p", {}, "Distance ", h("strong", {}, answer.distance.toFixed(3)), `, accepted up to ${answer.distance_threshold.toFixed(3)}.`),
    h("p", {}, h("strong", {}, id), `, at level ${answer.level}: strangers are accepted at ${percent(answer.fmr)} (${oneIn(answer.fmr)}).`),
    live ? h("p", {}, `Liveness: ${live}.`) : null,
    folded(
      "For support",
      h("p", { class: "fine" }, "Reason ", h("code", {}, answer.reason), ", request ", h("code", {}, answer.request_id)),
    ),
  );
}
