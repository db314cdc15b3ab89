// The field for a person's id. People are searched by how their ids begin, and picked from a list, with
// a key that may list them; with any other, and where the search fails, the id is typed.

import { command, field, h, newId, when } from "./dom.js";
import { LIFTS, call, may, session } from "./service.js";
import { lacking } from "./words.js";

const SHOWN = 8;
const PAUSE_MS = 200;
export const SPELLING = "1 to 128 letters, digits or .\u00a0_\u00a0@\u00a0:\u00a0-";

// A page of people whose ids begin so.
export const people = (prefix, { limit, cursor, signal }) =>
  call("GET", `/v1/subjects?${new URLSearchParams({ prefix, limit, ...(cursor ? { cursor } : {}) })}`, { signal });

export const about = (person) => [
  person.enrolled_by === "photos"
    ? `${person.photos} ${person.photos === 1 ? "photo" : "photos"}, `
    : "lifted by a client, ",
  "enrolled ",
  when(person.updated_at),
  person.holder_key ? ", locked to a holder key" : "",
  person.current ? "" : ". Enrolled under an earlier contract: enroll again",
];

// What the key, or the service, does not allow: said once, above the form that it switches off.
export function whyOff(right) {
  if (!may(right)) return lacking(right);
  if (!session.contract.photos) {
    return "This service runs without a model pack: it accepts lifted templates but no photos.";
  }
  return null;
}

// The next step where nobody is enrolled under an id.
export const enroller = (id) =>
  h("p", {}, h("a", { class: "button", href: `#/enroll/${encodeURIComponent(id)}` }, `Enroll ${id}`));

export function offNote(why) {
  if (!why) return null;
  const [said, typed] = why.split(/(?=veilface )/);
  return h("p", { class: "off", role: "note" }, said, typed ? command(typed) : null);
}

// Where private mode is missing, photos are not sent in silence.
export const switchOf = (mode) =>
  mode?.root ??
  offNote(LIFTS && !session.mode && "Private mode could not be loaded: photos are sent to the service. Reload the page.");

export function subjectField(id = "", listed = "Type how it begins, or pick from the list.") {
  const searches = may("enroll");
  const list = h("ul", { class: "options", role: "listbox", id: newId("people"), "aria-label": "People", hidden: true });
  const input = h("input", {
    type: "text",
    required: true,
    maxlength: "128",
    pattern: "[A-Za-z0-9._@:\\-]{1,128}",
    autocomplete: "off",
    autocapitalize: "none",
    spellcheck: "false",
    value: id,
    ...(searches
      ? { role: "combobox", "aria-autocomplete": "list", "aria-expanded": "false", "aria-controls": list.id }
      : {}),
  });
  const told = h("p", { class: "hint", role: "status" });
  input.addEventListener("input", () => input.setCustomValidity(input.validity.patternMismatch ? SPELLING : ""));
  const part = field("Person's id", input, searches ? listed : SPELLING);
  if (!searches) return [input, part];
  let running = new AbortController();
  let timer = 0;
  let active = -1;

  function stop() {
    clearTimeout(timer);
    running.abort();
    running = new AbortController();
  }

  function show(options) {
    list.replaceChildren(...options);
    list.hidden = !options.length;
    input.setAttribute("aria-expanded", String(!list.hidden));
    activate(-1);
  }

  function activate(index) {
    active = index;
    [...list.children].forEach((each, at) => each.setAttribute("aria-selected", String(at === index)));
    const now = list.children[index];
    now?.scrollIntoView({ block: "nearest" });
    if (now) input.setAttribute("aria-activedescendant", now.id);
    else input.removeAttribute("aria-activedescendant");
  }

  function pick(name) {
    input.value = name;
    show([]);
    for (const type of ["input", "change"]) input.dispatchEvent(new Event(type, { bubbles: true }));
  }

  // `browses`: the visitor asked to see people, whatever is typed already.
  async function search(browses) {
    stop();
    const { signal } = running;
    const typed = input.value;
    if (!browses && !typed) return tell("", []);
    let found;
    try {
      found = await people(typed, { limit: SHOWN, signal });
    } catch {
      // It is an aid: what is wrong, the form says when it is sent.
      return tell("", []);
    }
    if (signal.aborted || input.value !== typed) return;
    const { subjects, next_cursor: more } = found;
    const exact = subjects.find((each) => each.subject_id === typed);
    const one = subjects.length === 1 ? "1 person" : `${subjects.length}${more ? " or more" : ""} people`;
    if (exact && !browses) tell(["✓ ", about(exact)], []);
    else if (!subjects.length) tell(typed ? "Nobody is enrolled under this id." : "Nobody is enrolled yet.", []);
    else tell(typed ? `${one} found.` : `${one} enrolled.`, document.activeElement === input ? subjects : []);
  }

  function tell(words, subjects) {
    told.replaceChildren(...[words].flat(2));
    show(
      subjects.map((each) =>
        h(
          "li",
          {
            role: "option",
            id: newId("person"),
            "aria-selected": "false",
            // The field keeps the focus.
            onmousedown: (event) => event.preventDefault(),
            onclick: () => pick(each.subject_id),
          },
          h("strong", {}, each.subject_id),
          h("span", { class: "fine" }, about(each)),
        ),
      ),
    );
  }

  input.addEventListener("input", () => {
    stop();
    show([]);
    told.replaceChildren();
    timer = setTimeout(search, PAUSE_MS);
  });
  input.addEventListener("click", () => input.value || search(true));
  input.addEventListener("blur", () => show([]));
  input.addEventListener("keydown", (event) => {
    const count = list.children.length;
    const open = !list.hidden;
    if (event.key === "ArrowDown" && !open) search(true);
    else if (event.key === "ArrowDown") activate((active + 1) % count);
    else if (event.key === "ArrowUp" && open) activate((active <= 0 ? count : active) - 1);
    else if (event.key === "Enter" && open && active >= 0) pick(list.children[active].firstChild.textContent);
    else if (event.key === "Escape" && open) show([]);
    else return;
    event.preventDefault();
  });
  part.classList.add("combobox");
  input.after(list);
  part.append(told);
  if (id) search();
  return [input, part];
}
