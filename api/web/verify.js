import { facts, field, h, oneIn, percent } from "./dom.js";
import { offNote, subjectField, whyOff } from "./enroll.js";
import { photoPicker } from "./photos.js";
import { call, form, levels, session, subjectPath } from "./service.js";
import { problemBox } from "./words.js";

const REASONS = {
  match: "The photo matches the enrolled person.",
  no_match: "The photo does not match: a different person, a poor photo, or an id that nobody is enrolled under.",
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
        `${each.name}${each.target_fmr ? ` (${oneIn(each.target_fmr)})` : ""}`,
      ),
    ),
  );
  const result = h("div", { class: "result", role: "status" });
  const problem = h("div", {});
  const send = h("button", { type: "submit", disabled: true }, "Verify");
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
        most: 1,
        onchange: (ready) => {
          send.disabled = !ready;
          clear();
        },
      });
  subject.addEventListener("input", clear);
  level.addEventListener("change", clear);

  async function submit(event) {
    event.preventDefault();
    if (fields.disabled) return;
    clear();
    const asking = asked;
    const name = subject.value;
    const body = form("image", picker.blobs(), { level: level.value, face: picker.face() });
    fields.disabled = true;
    send.textContent = "Comparing…";
    try {
      const answer = await call("POST", `${subjectPath(name)}/verify`, { body });
      if (asking === asked) {
        result.replaceChildren(decision(name, answer));
        result.scrollIntoView({ block: "nearest" });
      }
    } catch (error) {
      if (asking === asked) problem.replaceChildren(problemBox(error));
    }
    fields.disabled = false;
    send.textContent = "Verify";
    send.disabled = !picker.ready();
    // A button that is switched off loses the focus.
    if (document.activeElement === document.body) send.focus();
  }

  const fields = h(
    "fieldset",
    { class: "plain", disabled: why !== null },
    subjectPart,
    field(
      "Level",
      level,
      "How often a stranger is accepted, by calibration. Stricter levels reject the right person " +
        "more often.",
    ),
    picker?.root ?? null,
    send,
  );

  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, "Verify"),
    h("p", { class: "lead" }, "Check whether a photo shows the person enrolled under an id."),
    offNote(why),
    h("form", { class: "card", onsubmit: submit }, fields),
    problem,
    result,
  );
  return {
    root,
    stop() {
      asked += 1;
      picker?.stop();
    },
  };
}

function decision(id, answer) {
  const accepted = answer.decision === "accept";
  return h(
    "div",
    { class: `verdict ${accepted ? "accept" : "reject"}` },
    h("p", { class: "verdict-word" }, accepted ? "✓ Accepted" : "✕ Rejected"),
    h("p", {}, REASONS[answer.reason]),
    facts([
      ["Person", id],
      ["Reason", h("code", {}, answer.reason)],
      ["Level", answer.level],
      ["False match rate", `${percent(answer.fmr)} (${oneIn(answer.fmr)})`],
      ["Distance", answer.distance === undefined ? null : answer.distance.toFixed(4)],
      ["Request", h("code", {}, answer.request_id)],
    ]),
    answer.notice ? h("p", { class: "fine" }, answer.notice) : null,
  );
}
