import { headMovements } from "./challenge.js";
import { facts, field, h, oneIn, percent, workbench } from "./dom.js";
import { holderKey } from "./holder.js";
import { photoPicker } from "./photos.js";
import { call, form, levels, may, moves, session, subjectPath } from "./service.js";
import { enroller, offNote, subjectField, switchOf, whyOff } from "./subject.js";
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
  const why = whyOff("verify");
  const [subject, subjectPart] = subjectField(id);
  const level = h(
    "select",
    {},
    levels().map((each) =>
      h(
        "option",
        { value: each.name, selected: each.name === session.contract.default_level },
        each.target_fmr ? `${oneIn(each.target_fmr)} (${each.name})` : each.name,
      ),
    ),
  );
  const result = h("div", { class: "result", role: "status" });
  const problem = h("div", {});
  const send = h("button", { type: "submit", disabled: true }, "Verify");
  const say = (text) => (send.textContent = text);
  // Counts what was asked: an answer to what is no longer on the page is not shown.
  let asked = 0;
  const clear = () => {
    asked += 1;
    result.replaceChildren();
    problem.replaceChildren();
  };
  const picker = why
    ? null
    : photoPicker({
        most: 5,
        replaces: true,
        onchange: (ready) => {
          send.disabled = !(ready || moving());
          clear();
        },
      });
  const mode = why === null ? session.mode?.offer("verify", showWhatIsAsked) : null;
  const movements = headMovements();
  const moving = () => why === null && moves();
  const instead = h("p", { class: "hint" }, "If you cannot turn your head, ask the operator for another way.");
  const steps = [h("span", {}), h("span", {})];

  function showWhatIsAsked() {
    clear();
    mode?.at(level.value, picker);
    steps.forEach((step, index) => (step.textContent = STEPS[moving() ? "movements" : "photos"][index]));
    if (!picker) return;
    picker.root.hidden = moving();
    if (moving()) picker.pause();
    movements.root.hidden = instead.hidden = !moving();
    say(moving() ? "Start head movements" : "Verify");
    send.disabled = !(picker.ready() || moving());
  }
  const holder = holderKey("verify", subject, clear);
  subject.addEventListener("input", clear);
  level.addEventListener("change", showWhatIsAsked);

  async function submit(event) {
    event.preventDefault();
    if (fields.disabled) return;
    clear();
    const asking = asked;
    const name = subject.value;
    const sent = picker.chosen();
    const lifts = session.mode?.active();
    fields.disabled = true;
    try {
      const holder_key = await holder.key(name, say);
      const asksToMove = moving();
      const { photos, ...shown } = asksToMove
        ? await movements.frames(name)
        : { photos: picker.blobs(), face: picker.face() };
      say("Comparing…");
      const given = { level: level.value, ...shown, holder_key };
      const answer = await (lifts
        ? session.mode.verify(name, { photos, ...given })
        : call("POST", `${subjectPath(name)}/verify`, { body: form("images", photos, given) }));
      if (asking === asked) {
        result.replaceChildren(decision(name, answer, asksToMove ? "movements" : "photos"));
        if (lifts) result.append(session.mode.whatLeft());
        result.scrollIntoView({ block: "nearest" });
      }
    } catch (error) {
      if (asking === asked) {
        if (error.details && !moving()) picker.blame(error, sent);
        problem.replaceChildren(problemBox(error));
        if (error.code === "locked_out" && may("admin")) problem.append(lifter(name));
        if (error.code === "not_enrolled" && may("enroll")) problem.append(enroller(name));
        if (lifts) problem.append(session.mode.whatLeft());
        problem.scrollIntoView({ block: "nearest" });
      }
    }
    fields.disabled = false;
    say(moving() ? "Start head movements" : "Verify");
    send.disabled = !(picker.ready() || moving());
    // A button that is switched off loses the focus.
    if (document.activeElement === document.body) send.focus();
  }

  // For operators: the lock is lifted where it was met.
  const lifter = (name) =>
    h(
      "button",
      {
        type: "button",
        class: "secondary",
        onclick: async () => {
          try {
            await call("DELETE", `${subjectPath(name)}/lockout`);
            problem.replaceChildren(h("p", { class: "off", role: "status" }, `The lock on ${name} is lifted.`));
            send.focus();
          } catch (error) {
            problem.prepend(problemBox(error));
          }
        },
      },
      "Lift the lock",
    );

  const fields = h(
    "fieldset",
    { class: "plain", disabled: why !== null },
    h(
      "div",
      { class: "pair" },
      subjectPart,
      field("Level", level, "How often a stranger is accepted. Stricter levels reject the right person more often."),
    ),
    switchOf(mode),
    picker?.root ?? null,
    why ? null : movements.root,
    instead,
    holder.parts,
    send,
  );

  const entry = h("form", { class: "card", onsubmit: submit }, fields);
  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, "Verify"),
    h("p", { class: "lead" }, "Check whether photos show the person enrolled under an id. Several are averaged."),
    offNote(why),
    workbench(entry, "The decision", ["Choose the person.", ...steps], problem, result),
  );
  picker?.dropOn(entry);
  showWhatIsAsked();
  return {
    root,
    stop() {
      asked += 1;
      movements.stop();
      holder.stop();
      picker?.stop();
    },
  };
}

function decision(id, answer, sent) {
  const accepted = answer.decision === "accept";
  return h(
    "div",
    { class: `verdict ${accepted ? "accept" : "reject"}` },
    h("p", { class: "verdict-word" }, accepted ? "✓ Accepted" : "✕ Rejected"),
    h("p", {}, REASONS[answer.reason] ?? LIVENESS[sent]),
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
