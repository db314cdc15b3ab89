// The field for a person's id. With a key that may list people, the browser suggests those whose ids begin
// so; with any other, and where the search fails, the id is typed.

import { command, field, h, newId, plural, when } from "./dom.js";
import { LIFTS, call, may, session } from "./service.js";
import { lacking } from "./words.js";

const SHOWN = 8;
const PAUSE_MS = 200;

// A page of people whose ids begin so.
export const people = (prefix, { limit, cursor, signal }) =>
  call("GET", `/v1/subjects?${new URLSearchParams({ prefix, limit, ...(cursor ? { cursor } : {}) })}`, { signal });

export const about = (person) => [
  person.enrolled_by === "photos" ? `${plural(person.photos, "photo", "photos")}, ` : "lifted by a client, ",
  when(person.updated_at, { brief: true }),
  person.holder_key ? ", locked to a holder key" : "",
  person.current ? "" : ". Enrolled under an earlier contract: enroll again",
];

// What the key, or the service, does not allow: said once, above the form that it switches off.
export function whyOff(right) {
  if (!may(right)) return lacking(right);
  if (session.contract.photos) return null;
  return "This service runs without a model pack: it accepts lifted templates but no photos.";
}

// The next step where nobody is enrolled under an id.
export const enroller = (id) =>
  h("p", { class: "row" }, h("a", { class: "button", href: `#/enroll/${encodeURIComponent(id)}` }, `Enroll ${id}`));

export function offNote(why) {
  if (!why) return null;
  const [reason, typed] = why.split(/(?=veilface )/);
  return h("p", { class: "off", role: "note" }, reason, typed ? command(typed) : null);
}

// Where private mode is missing, photos are not sent in silence.
export const switchOf = (mode) =>
  mode?.root ??
  offNote(LIFTS && !session.mode && "Private mode could not be loaded: photos are sent to the service. Reload the page.");

// `input`, its `part` of the form, `id()` in the form in which the service keeps it, and `searched()`, which waits
// for the search that goes on. `onperson` is called with the person who is enrolled under the id, or null. Searches end with `until`.
export function subjectField(id, action, onperson, until) {
  const searches = may("enroll");
  const list = h("datalist", { id: newId("people") });
  const status = h("p", { class: "hint", role: "status" });
  const input = h("input", {
    type: "text",
    required: true,
    maxlength: "256",
    autocomplete: "off",
    autocapitalize: "none",
    spellcheck: "false",
    list: searches ? list.id : null,
    value: id,
  });
  const part = field("Person’s id", input);
  // However it was typed, a passkey of it is the same.
  const typedId = () => input.value.normalize("NFC");
  if (!searches) return { input, part, id: typedId, searched: async () => {} };
  let running = new AbortController();
  let timer = 0;
  let searching = null;

  async function search() {
    timer = 0;
    const { signal } = running;
    const typed = typedId();
    // It is an aid: what is wrong, the form says when it is sent.
    const page = await people(typed, { limit: SHOWN, signal }).catch(() => null);
    if (signal.aborted) return;
    const exact = page?.subjects.find((each) => each.subject_id === typed);
    status.replaceChildren(...(page ? words(page, typed, exact) : []));
    list.replaceChildren(
      ...(page?.subjects ?? []).map((each) =>
        h("option", { value: each.subject_id }, h("span", {}, about(each)).textContent),
      ),
    );
    if (page) onperson(exact ?? null);
  }

  function words({ subjects, next_cursor: more }, typed, exact) {
    if (exact) return ["✓ Enrolled: ", ...about(exact)];
    if (action === "enroll" && typed) return ["New person."];
    if (!subjects.length) return [typed ? "Nobody is enrolled under this id." : "Nobody is enrolled yet."];
    return [`${more ? "More than " : ""}${plural(subjects.length, "person", "people")} ${typed ? "found" : "enrolled"}.`];
  }

  function stop() {
    clearTimeout(timer);
    running.abort();
    running = new AbortController();
  }

  input.addEventListener("input", () => {
    stop();
    status.replaceChildren();
    timer = setTimeout(() => (searching = search()), PAUSE_MS);
  });
  input.addEventListener("focus", () => input.value || list.childElementCount || search());
  until.addEventListener("abort", stop);
  part.append(list, status);
  if (id) searching = search();
  async function searched() {
    if (timer) {
      clearTimeout(timer);
      searching = search();
    }
    await searching;
  }
  return { input, part, id: typedId, searched };
}
