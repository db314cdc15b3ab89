// The field for a person's id. With a key that may list people, the browser suggests those whose ids begin
// so; with any other, and where the search fails, the id is typed.

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
  const list = h("datalist", { id: newId("people") });
  const told = h("p", { class: "hint", role: "status" });
  const input = h("input", {
    type: "text",
    required: true,
    maxlength: "128",
    pattern: "[A-Za-z0-9._@:\\-]{1,128}",
    autocomplete: "off",
    autocapitalize: "none",
    spellcheck: "false",
    list: searches ? list.id : null,
    value: id,
  });
  input.addEventListener("input", () => input.setCustomValidity(input.validity.patternMismatch ? SPELLING : ""));
  const part = field("Person's id", input, searches ? listed : SPELLING);
  if (!searches) return [input, part];
  let running = new AbortController();
  let timer = 0;

  async function search() {
    const { signal } = running;
    const typed = input.value;
    // It is an aid: what is wrong, the form says when it is sent.
    const found = await people(typed, { limit: SHOWN, signal }).catch(() => null);
    if (signal.aborted) return;
    told.replaceChildren(...(found ? said(found, typed) : []));
    list.replaceChildren(
      ...(found?.subjects ?? []).map((each) =>
        h("option", { value: each.subject_id }, h("span", {}, about(each)).textContent),
      ),
    );
  }

  input.addEventListener("input", () => {
    clearTimeout(timer);
    running.abort();
    running = new AbortController();
    told.replaceChildren();
    timer = setTimeout(search, PAUSE_MS);
  });
  input.addEventListener("focus", () => input.value || list.childElementCount || search());
  part.append(list, told);
  if (id) search();
  return [input, part];
}

function said({ subjects, next_cursor: more }, typed) {
  const exact = subjects.find((each) => each.subject_id === typed);
  if (exact) return ["✓ ", ...about(exact)];
  if (!subjects.length) return [typed ? "Nobody is enrolled under this id." : "Nobody is enrolled yet."];
  const one = subjects.length === 1 ? "1 person" : `${subjects.length}${more ? " or more" : ""} people`;
  return [`${one} ${typed ? "found" : "enrolled"}.`];
}
