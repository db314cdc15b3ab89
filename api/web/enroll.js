import { confirmed, facts, h } from "./dom.js";
import { photoForm } from "./form.js";
import { call, form, session, subjectPath } from "./service.js";
import { personOf } from "./subject.js";

// Photos that make a reliable login, by the figures of docs/thresholds.md.
const ENOUGH = 3;
const STEPS = [
  "The service finds the face in each photo, and says at once whether the photo will do.",
  "The faces become one embedding, and that becomes a set which holds decoys as well.",
  "Only that set is stored, encrypted. Photos and embedding are forgotten.",
];

function progress(count) {
  if (count === 0) return "Three photos make a reliable login.";
  return count < ENOUGH ? `${ENOUGH - count} more for a reliable login.` : "✓ Enough for a reliable login.";
}

export function enrollView(id) {
  const ended = new AbortController();
  // The template that the visitor agreed to replace in private mode.
  let replaceable = null;

  const mayReplace = (name) =>
    confirmed(
      `Replace ${name}’s enrollment?`,
      "Enrolling again replaces the template and its lock. Fewer photos make the login less reliable.",
      "Replace",
      ended.signal,
    );

  // The service says whom it would replace, and replaces nobody else: so nothing is replaced unasked.
  async function send(name, { photos, ...fields }, say) {
    say("Enrolling…");
    // `replaces` is the template that may be replaced, or null.
    const put = (replaces) =>
      call("PUT", `${subjectPath(name)}/enrollment`, {
        body: form("images", photos, fields),
        headers: replaces ? { "If-Match": `"${replaces}"` } : { "If-None-Match": "*" },
      });
    try {
      return await put(null);
    } catch (error) {
      const known = error.code === "enrollment_conflict" && error.details.template_id;
      if (!known) throw error;
      return (await mayReplace(name)) ? await put(known) : null;
    }
  }

  // A token may replace whatever there is, or nobody: so the question comes first.
  async function token(name) {
    const person = await personOf(name, ended.signal);
    if (person && person.template_id !== replaceable) {
      if (!(await mayReplace(name))) throw new DOMException("The earlier enrollment stays.", "AbortError");
      replaceable = person.template_id;
    }
    return { replace: Boolean(person) };
  }

  return photoForm(id, {
    action: "enroll",
    title: "Enroll",
    lead: "Photos of one person become one private template.",
    empty: (lifts) => h("ol", {}, (lifts ? session.mode.STEPS : STEPS).map((step) => h("li", {}, step))),
    most: 10,
    always: true,
    verb: "Enroll",
    progress,
    send,
    token,
    show: enrolled,
    stop: () => ended.abort(),
  });
}

function enrolled(id, answer) {
  return h(
    "div",
    { class: "verdict accept", tabindex: "-1" },
    h("p", { class: "verdict-word" }, answer.replaced ? "✓ Enrolled again" : "✓ Enrolled"),
    facts([
      ["Person", id],
      ["Photos used", answer.images.length ? String(answer.images.length) : null],
      ["Earlier enrollment", answer.replaced ? "replaced" : "none"],
      ["Holder key", answer.holder_key ? "needed at every verification" : null],
      ["Template", h("code", {}, answer.template_id)],
    ]),
    h("p", { class: "row" }, h("a", { class: "button", href: `#/verify/${encodeURIComponent(id)}` }, "Verify this person")),
  );
}
