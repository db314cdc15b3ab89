import { command, confirmed, download, facts, field, h, when } from "./dom.js";
import { call, may, subjectPath } from "./service.js";
import { about, enroller, offNote, people } from "./subject.js";
import { lacking, problemBox } from "./words.js";

const PAGE = 25;
const PAUSE_MS = 200;

export function peopleView() {
  const list = h("ul", { class: "people" });
  const said = h("p", { class: "hint", role: "status" }, "");
  const problem = h("div", {});
  const receipts = h("div", { class: "result" });
  const prefix = h("input", { type: "search", autocomplete: "off", autocapitalize: "none", spellcheck: "false" });
  const more = h("button", { type: "button", class: "secondary", hidden: true, onclick: load }, "Show more");
  const title = h("h1", { tabindex: "-1" }, "People");
  const why = may("enroll") ? null : lacking("enroll");
  let cursor = null;
  const ended = new AbortController();
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
      if (!cursor) list.replaceChildren();
      const added = page.subjects.map(card);
      list.append(...added);
      if (cursor) added[0]?.querySelector("a, button")?.focus();
      cursor = page.next_cursor;
      more.hidden = cursor === null;
      count();
    } catch (error) {
      if (asking !== asked) return;
      problem.replaceChildren(problemBox(error));
    }
    more.disabled = false;
  }

  function count() {
    const shown = list.childElementCount;
    said.textContent = shown
      ? `${shown} ${shown === 1 ? "person" : "people"} shown${cursor ? ", with more to come" : ""}.`
      : prefix.value
        ? "Nobody’s id begins so."
        : "Nobody is enrolled yet.";
    none.hidden = shown > 0 || prefix.value !== "";
    unknown.replaceChildren(...(!shown && prefix.value ? [enroller(prefix.value)] : []));
  }

  function card(person) {
    const id = person.subject_id;
    const path = encodeURIComponent(id);
    const erasing = may("erase");
    const erase = h(
      "button",
      {
        type: "button",
        class: "danger",
        disabled: !erasing,
        title: erasing ? null : lacking("erase"),
        "aria-label": `Erase ${id}`,
        onclick: () => eraseAsked(id, item),
      },
      "Erase…",
    );
    const item = h(
      "li",
      { class: "person" },
      h("div", {}, h("h2", {}, id), h("p", { class: "hint" }, about(person))),
      h(
        "p",
        { class: "row" },
        h("a", { href: `#/verify/${path}`, "aria-label": `Verify ${id}` }, "Verify"),
        h("a", { href: `#/enroll/${path}`, "aria-label": `Enroll ${id} again` }, "Enroll again"),
        erase,
      ),
    );
    return item;
  }

  async function eraseAsked(id, item) {
    const agreed = await confirmed(
      `Erase ${id}?`,
      "This removes the template, its key and everything else that is kept about this person. It cannot " +
        "be undone. You get a signed receipt.",
      "Erase",
      ended.signal,
    );
    if (!agreed) return;
    problem.replaceChildren();
    item.querySelector("button").disabled = true;
    try {
      const answer = await call("DELETE", subjectPath(id));
      item.remove();
      count();
      const shown = receipt(id, answer);
      // Those of earlier erasures stay: they may not have been downloaded yet.
      receipts.prepend(shown);
      shown.focus();
    } catch (error) {
      item.querySelector("button").disabled = false;
      problem.replaceChildren(problemBox(error));
      problem.scrollIntoView({ block: "nearest" });
    }
  }

  const none = h(
    "section",
    { class: "card empty", hidden: true },
    h("h2", {}, "Enroll the first person"),
    h("p", {}, "Three photos by one click are enough. Whoever is enrolled can be verified, and erased, at once."),
    h("p", {}, h("a", { class: "button", href: "#/enroll" }, "Enroll")),
  );
  const unknown = h("div", {});
  prefix.addEventListener("input", search);
  if (!why) load();
  const stop = () => {
    clearTimeout(timer);
    ended.abort();
  };
  const root = h(
    "section",
    {},
    title,
    h("p", { class: "lead" }, "Everyone who is enrolled, by id."),
    offNote(why),
    may("erase") ? null : offNote(lacking("erase")),
    receipts,
    problem,
    why ? null : h("div", { class: "find" }, field("Find people whose id begins with", prefix)),
    said,
    none,
    unknown,
    list,
    more,
  );
  return { root, stop };
}

function receipt(id, answer) {
  const { claims } = answer;
  const text = JSON.stringify(answer, null, 1);
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
    h(
      "p",
      { class: "row" },
      h(
        "button",
        {
          type: "button",
          class: "secondary",
          onclick: () => download(`receipt-${claims.receipt_id}.json`, text),
        },
        "Download receipt",
      ),
    ),
    h(
      "p",
      { class: "fine" },
      "Check it with ",
      command("veilface keys verify-receipt receipt.json --public-key contract.json"),
      "; download the contract under Service.",
    ),
  );
}
