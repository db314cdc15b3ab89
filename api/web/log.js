import { h, row, table, when } from "./dom.js";
import { call, may } from "./service.js";
import { offNote, subjectField } from "./subject.js";
import { lacking, problemBox } from "./words.js";

const PAGE = 50;

// For operators: who did what to whom, the latest first.
export function logView(id) {
  const why = may("admin") ? null : lacking("admin");
  const [subject, subjectPart] = subjectField(id);
  subject.required = false;
  const problem = h("div", {});
  const said = h("p", { class: "hint", role: "status" });
  const shown = table("Lines, the latest first", ["Time", "Action", "Outcome", "Detail", "Who", "Person (pseudonym)", "Request"], []);
  shown.hidden = true;
  const lines = shown.querySelector("tbody");
  const more = h("button", { type: "button", class: "secondary", hidden: true, onclick: () => load() }, "Show earlier");
  let cursor = null;
  let person = id;

  async function load(event) {
    event?.preventDefault();
    if (event) {
      person = subject.value;
      cursor = null;
    }
    more.disabled = true;
    problem.replaceChildren();
    try {
      const wanted = { limit: PAGE, ...(person ? { subject_id: person } : {}), ...(cursor ? { cursor } : {}) };
      const page = await call("GET", `/v1/audit-log?${new URLSearchParams(wanted)}`);
      if (!cursor) lines.replaceChildren();
      lines.append(...page.lines.map((line) => row(cells(line))));
      cursor = page.next_cursor;
      more.hidden = cursor === null;
      const count = lines.childElementCount;
      shown.hidden = count === 0;
      said.textContent = count
        ? `${count} lines shown${cursor ? ", with earlier ones to come" : ""}.`
        : `No line${person ? ` about ${person}` : ""}${cursor ? " yet: look further back" : ""}.`;
    } catch (error) {
      problem.replaceChildren(problemBox(error));
    }
    more.disabled = false;
  }

  if (!why) load();
  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, "Audit log"),
    h(
      "p",
      { class: "lead" },
      "Who did what to whom in this key’s tenant, the latest first. A line names a person by a pseudonym only. ",
      "Nothing is verified here: ",
      h("code", {}, "veilface audit-log verify"),
      " shows whether a line was altered or removed.",
    ),
    offNote(why),
    why
      ? null
      : h(
          "form",
          { class: "card inline", onsubmit: load },
          subjectPart,
          h("button", { type: "submit", class: "secondary" }, "Show"),
        ),
    problem,
    why ? null : h("div", { class: "card" }, shown, said),
    more,
  );
  return { root, stop() {} };
}

const cells = ({ at, action, outcome, detail, actor, subject, request_id: request }) => [
  when(at),
  action,
  outcome,
  detail,
  actor,
  subject ? h("code", {}, subject.slice(0, 16)) : null,
  request ? h("code", {}, request) : null,
].map((each) => each ?? "");
