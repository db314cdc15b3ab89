import { headMovements } from "./challenge.js";
import { facts, field, h, oneIn, percent } from "./dom.js";
import { photoForm } from "./form.js";
import { call, form, levels, may, moves, session, subjectPath } from "./service.js";
import { enroller } from "./subject.js";
import { DEMO, livenessWords, problemBox } from "./words.js";

const REASONS = {
  match: "The face matches the enrolled person.",
  no_match: "No match: another person, poor photos, an id that nobody is enrolled under, or a holder key that is wrong " +
    "or missing. Check the id, and try other photos. If a holder key is lost, enroll the person again.",
};

// What to do differently depends on what was asked for.
const NOT_LIVE = "Nothing shows that a living person is before the camera. ";
const LIVENESS = {
  movements: NOT_LIVE + "Follow each movement as it is asked for, in good light.",
  photos: NOT_LIVE + "Take new photos with the camera, of the face itself and in good light.",
};

const ANSWER = "The answer appears here: accepted or rejected, and how often a stranger would be accepted.";
const STEPS = {
  movements: ["Press Start head movements. The camera opens.", `Follow each movement for about twelve seconds. ${ANSWER}`],
  photos: [
    DEMO ? "Choose a photo of a cartoon person." : "Take three photos by one click, or choose up to five files.",
    `Press Verify. ${ANSWER}`,
  ],
};

export function verifyView(id) {
  const level = h(
    "select",
    { onchange: () => view.refresh() },
    levels().map((each) =>
      h(
        "option",
        { value: each.name, selected: each.name === session.contract.default_level },
        each.target_fmr ? `${oneIn(each.target_fmr)} (${each.name})` : each.name,
      ),
    ),
  );
  const asked = () => (moves() ? "movements" : "photos");

  async function send(name, { photos, ...given }, { lifts, say }) {
    say("Comparing…");
    const fields = { level: level.value, ...given };
    return lifts
      ? lifts.verify(name, { photos, ...fields })
      : call("POST", `${subjectPath(name)}/verify`, { body: form("images", photos, fields) });
  }

  function remedies({ code }, name, { problem, send: button }) {
    if (code === "locked_out" && may("admin")) return [lifter(name, problem, button)];
    if (code === "not_enrolled" && may("enroll")) return [enroller(name)];
    return [];
  }

  const view = photoForm(id, {
    action: "verify",
    title: "Verify",
    lead: "Check whether photos show the person enrolled under an id. Several are averaged.",
    beside: field("Level", level, "How often a stranger is accepted. Stricter levels reject the right person more often."),
    heading: "The decision",
    steps: () => ["Choose the person.", ...STEPS[asked()]],
    most: 5,
    replaces: true,
    level: () => level.value,
    movements: headMovements(),
    moving: moves,
    verb: () => (moves() ? "Start head movements" : "Verify"),
    send,
    show: (name, answer) => decision(name, answer, asked()),
    remedies,
  });
  return view;
}

// For operators: the lock is lifted where it was met.
function lifter(name, problem, button) {
  const lift = async () => {
    try {
      await call("DELETE", `${subjectPath(name)}/lockout`);
      problem.replaceChildren(h("p", { class: "off", role: "status" }, `The lock on ${name} is lifted.`));
      button.focus();
    } catch (error) {
      problem.prepend(problemBox(error));
    }
  };
  return h("button", { type: "button", class: "secondary", onclick: lift }, "Lift the lock");
}

function decision(id, answer, asked) {
  const accepted = answer.decision === "accept";
  return h(
    "div",
    { class: `verdict ${accepted ? "accept" : "reject"}` },
    h("p", { class: "verdict-word" }, accepted ? "✓ Accepted" : "✕ Rejected"),
    h("p", {}, REASONS[answer.reason] ?? LIVENESS[asked]),
    answer.advice ? h("p", {}, answer.advice) : null,
    facts([
      ["Person", id],
      ["Level", answer.level],
      ["False match rate", `${percent(answer.fmr)} (${oneIn(answer.fmr)})`],
      ["Liveness", livenessWords(answer)],
      ["Distance", answer.distance === undefined ? null : answer.distance.toFixed(4)],
    ]),
    h("p", { class: "fine" }, "Reason ", h("code", {}, answer.reason), ", request ", h("code", {}, answer.request_id)),
    answer.notice ? h("p", { class: "fine" }, answer.notice) : null,
  );
}
