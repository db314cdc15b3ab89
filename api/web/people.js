import { command, confirmed, download, facts, field, h, plural, when } from "./dom.js";
import { call, may, subjectPath } from "./service.js";
import { about, offNote, people } from "./subject.js";
import { lacking, problemBox } from "./words.js";

const PAGE = 100;
const PAUSE_MS = 200;
export function peopleView() {
  const list = h("ul", { class: "people" });
  const status = h("p", { class: "hint", role: "status" });
  const problem = h("div", {});
  const receipts = h("div", { class: "result" });
  const prefix = h("input", { type: "search", autocomplete: "off", autocapitalize: "none", spellcheck: "false" });
  const more = h("button", { type: "button", class: "secondary", hidden: true, onclick: () => load() }, "Show more");
  const none = h(
    "section",
    { class: "empty", hidden: true },
    h("h2", {}, "Nobody is enrolled yet"),
    h("p", {}, "Three photos, taken by one click, are enough. The person can then be verified, and erased, at once."),
    h("a", { class: "button", href: "#/enroll" }, "Enroll the first person"),
  );
  const why = may("enroll") ? null : lacking("enroll");
  const ended = new AbortController();
  let shown = [];
  let cursor = null;
  let asked = 0;
  let timer = 0;

  function search() {
    clearTimeout(timer);
    timer = setTimeout(() => {
      cursor = null;
      load();
    }, PAUSE_MS);
  }

  async function load() {
    const asking = (asked += 1);
    more.disabled = true;
    problem.replaceChildren();
    try {
      const page = await people(prefix.value, { limit: PAGE, cursor });
      if (asking !== asked) return;
      const added = page.subjects;
      const next = cursor !== null;
      shown = next ? [...shown, ...added] : added;
      cursor = page.next_cursor;
      refill();
      if (next) list.querySelector(`[data-id="${CSS.escape(added[0]?.subject_id ?? "")}"] a`)?.focus();
    } catch (error) {
      if (asking !== asked) return;
      problem.replaceChildren(problemBox(error));
    }
    more.disabled = false;
  }

  function refill() {
    list.replaceChildren(...shown.map(entry));
    more.hidden = cursor === null;
    status.textContent = prefix.value && !shown.length
      ? "Nobody’s id begins so."
      : `${plural(shown.length, "person", "people")} shown${cursor ? ", with more to come" : ""}.`;
    none.hidden = shown.length > 0 || prefix.value !== "";
    status.hidden = !none.hidden;
  }

  function entry(person) {
    const id = person.subject_id;
    const path = encodeURIComponent(id);
    const erasing = may("erase");
    const off = erasing ? null : lacking("erase");
    const ask = (event) => eraseAsked(id, event.target);
    return h(
      "li",
      { class: "person", "data-id": id },
      h("div", {}, h("h2", {}, id), h("p", { class: "hint" }, about(person))),
      h("a", { href: `#/verify/${path}`, "aria-label": `Verify ${id}` }, "Verify"),
      h("a", { href: `#/enroll/${path}`, "aria-label": `Enroll ${id} again` }, "Enroll again"),
      h(
        "button",
        { type: "button", class: "quiet erase", disabled: !erasing, title: off, "aria-label": `Erase ${id}`, onclick: ask },
        "Erase",
      ),
    );
  }

  async function eraseAsked(id, button) {
    const agreed = await confirmed(
      `Erase ${id}?`,
      "This removes the template, its key and everything else that is kept about this person. It cannot be undone. " +
        "You get a signed receipt.",
      "Erase",
      ended.signal,
    );
    if (!agreed) return;
    problem.replaceChildren();
    button.disabled = true;
    try {
      const answer = await call("DELETE", subjectPath(id));
      shown = shown.filter((person) => person.subject_id !== id);
      refill();
      const latest = receipt(id, answer);
      // Those of earlier erasures stay: they may not have been downloaded yet.
      receipts.prepend(latest);
      latest.focus();
    } catch (error) {
      button.disabled = false;
      problem.replaceChildren(problemBox(error));
      problem.scrollIntoView({ block: "nearest" });
    }
  }

  prefix.addEventListener("input", search);
  if (!why) load();
  const root = h(
    "section",
    {},
    h(
      "div",
      { class: "heading" },
      h("h1", { tabindex: "-1" }, "People"),
      why ? null : h("a", { class: "button", href: "#/enroll" }, "Enroll"),
    ),
    offNote(why),
    may("erase") ? null : offNote(lacking("erase")),
    receipts,
    problem,
    why ? null : field("Find by how the id begins", prefix),
    status,
    none,
    list,
    more,
  );
  return {
    root,
    stop() {
      clearTimeout(timer);
      ended.abort();
    },
  };
}

function receipt(id, answer) {
  const { claims } = answer;
  const save = () => download(`receipt-${claims.receipt_id}.json`, JSON.stringify(answer, null, 1));
  return h(
    "div",
    { class: "verdict accept", role: "status", tabindex: "-1" },
    h("p", { class: "verdict-word" }, `Erased ${id}`),
    facts([
      ["Erased at", when(claims.erased_at)],
      ["Removed", claims.erased.map((each) => `${each.item.replaceAll("_", " ")} (${each.count})`).join(", ")],
      ["Pseudonym on the receipt", h("code", {}, `${claims.subject.slice(0, 16)}…`)],
      ["Signing key", h("code", {}, claims.signing_key)],
    ]),
    h("p", { class: "row" }, h("button", { type: "button", class: "secondary", onclick: save }, "Download receipt")),
    h(
      "p",
      { class: "fine" },
      "Check it with ",
      command("veilface keys verify-receipt receipt.json --public-key contract.json"),
      "; download the contract under Service.",
    ),
  );
}
