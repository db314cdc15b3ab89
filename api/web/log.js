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
  // Of the lines that are shown.
  let cursor = null;
  let person = id;
  let asked = 0;

  async function load(event) {
    event?.preventDefault();
    const asking = (asked += 1);
    const about = event ? subject.value : person;
    const from = event ? null : cursor;
    more.disabled = true;
    problem.replaceChildren();
    let page;
    try {
      const wanted = { limit: PAGE, ...(about ? { subject_id: about } : {}), ...(from ? { cursor: from } : {}) };
      page = await call("GET", `/v1/audit-log?${new URLSearchParams(wanted)}`);
    } catch (error) {
      if (asking === asked) problem.replaceChildren(problemBox(error));
    }
    // Another question was asked meanwhile, and its answer counts.
    if (asking !== asked) return;
    more.disabled = false;
    if (!page) return;
    person = about;
    cursor = page.next_cursor;
    if (!from) lines.replaceChildren();
    lines.append(...page.lines.map((line) => row(line.altered ? altered(line) : cells(line))));
    more.hidden = cursor === null;
    const count = lines.childElementCount;
    shown.hidden = count === 0;
    said.textContent = count
      ? `${count} lines shown${cursor ? ", with earlier ones to come" : ""}.`
      : `No line${person ? ` about ${person}` : ""}${cursor ? " yet: look further back" : ""}.` +
        (person ? " Empty the field and press Show for all lines." : "");
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
      "Whether lines were removed or moved is not seen here: ",
      h("code", {}, "veilface audit-log verify"),
      " shows it.",
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

const altered = ({ sequence }) => [
  `Line ${sequence}`,
  "altered",
  "",
  ["Not as it was written. Run ", h("code", {}, "veilface audit-log verify")],
  "",
  "",
  "",
];
