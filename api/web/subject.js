// The field for a person's id, and who is enrolled under it, where the key may know.

import { command, field, h, plural, when } from "./dom.js";
import { LIFTS, call, may, session } from "./service.js";
import { lacking } from "./words.js";

const PAUSE_MS = 200;

// A page of people whose ids begin so.
export const people = (prefix, { limit, cursor, signal }) =>
  call("GET", `/v1/subjects?${new URLSearchParams({ prefix, limit, ...(cursor ? { cursor } : {}) })}`, { signal });

// Who is enrolled under this very id, or null: the first of those whose ids begin so.
export async function personOf(id, signal) {
  const [first] = (await people(id, { limit: 1, signal })).subjects;
  return first?.subject_id === id ? first : null;
}

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

export function offNote(why) {
  if (!why) return null;
  const [reason, typed] = why.split(/(?=veilface )/);
  return h("p", { class: "off", role: "note" }, reason, typed ? command(typed) : null);
}

// Where private mode is missing, photos are not sent in silence.
export const switchOf = (mode) =>
  mode?.root ??
  offNote(
    LIFTS && !session.mode &&
      (session.client
        ? "Private mode could not be loaded: photos are sent to the service. Reload the page."
        : "Private mode is not offered: this service was installed without the client that it needs (make javascript)."),
  );

// `input`, its `part` of the form, `id()` in the form in which the service keeps it, and `searched()`, which waits
// for the search that goes on. `onperson` is called with the person who is enrolled under the id, or null. Searches end with `until`.
export function subjectField(id, action, onperson, until) {
  const status = h("p", { class: "hint", role: "status" });
  const input = h("input", {
    type: "text",
    required: true,
    maxlength: "256",
    autocomplete: "off",
    autocapitalize: "none",
    spellcheck: "false",
    value: id,
  });
  const part = field("Person’s id", input);
  part.append(status);
  // However it was typed, a passkey of it is the same.
  const typedId = () => input.value.normalize("NFC");
  let running = new AbortController();
  let timer = 0;
  let searching = null;

  async function search() {
    timer = 0;
    const { signal } = running;
    try {
      const person = typedId() ? await personOf(typedId(), signal) : null;
      signal.throwIfAborted();
      const nobody = action === "enroll" ? "New person." : "Nobody is enrolled under this id.";
      status.replaceChildren(...(person ? ["✓ Enrolled: ", ...about(person)] : typedId() ? [nobody] : []));
      onperson(person);
    } catch {
      // It is an aid: what is wrong, the form says when it is sent.
    }
  }

  function stop() {
    clearTimeout(timer);
    running.abort();
    running = new AbortController();
  }

  if (may("enroll")) {
    input.addEventListener("input", () => {
      stop();
      status.replaceChildren();
      timer = setTimeout(() => (searching = search()), PAUSE_MS);
    });
    if (id) searching = search();
  }
  until.addEventListener("abort", stop);
  async function searched() {
    if (timer) {
      clearTimeout(timer);
      searching = search();
    }
    await searching;
  }
  return { input, part, id: typedId, searched };
}
