import { confirmed, facts, h } from "./dom.js";
import { photoForm } from "./form.js";
import { call, form, session, subjectPath } from "./service.js";
import { SPELLING } from "./subject.js";

const STEPS = [
  "The service finds the face in each photo and says at once whether the photo will do.",
  "Your model turns the faces into one embedding, which is hidden in a set that holds decoys as well.",
  "Only that set is stored, encrypted. Photos and embedding are forgotten.",
];

export function enrollView(id) {
  const ended = new AbortController();

  // The service says whom it would replace, and replaces nobody else: so nothing is replaced unasked.
  async function send(name, given, { lifts, say }) {
    say("Enrolling…");
    const { photos, ...fields } = given;
    // `replaces` is the template that may be replaced, or null.
    const put = (replaces) =>
      lifts
        ? lifts.enroll(name, given, replaces)
        : call("PUT", `${subjectPath(name)}/enrollment`, {
            body: form("images", photos, fields),
            headers: replaces ? { "If-Match": `"${replaces}"` } : { "If-None-Match": "*" },
          });
    try {
      return await put(null);
    } catch (error) {
      const known = error.code === "enrollment_conflict" && error.details.template_id;
      if (!known) throw error;
      const agreed = await confirmed(
        `Replace ${name}’s enrollment?`,
        "This person is enrolled already. Enrolling again replaces their template and its lock.",
        "Replace",
        ended.signal,
      );
      return agreed ? await put(known) : null;
    }
  }

  return photoForm(id, {
    action: "enroll",
    title: "Enroll",
    lead:
      "One to ten photos of a person become one private template. " +
      "Whoever is enrolled already is replaced only if you confirm it.",
    idHint: `A new id (${SPELLING}), or whom to enroll again.`,
    heading: "What happens to the photos",
    steps: () => (session.mode?.active() ? session.mode.STEPS : STEPS),
    most: 10,
    always: true,
    verb: () => "Enroll",
    send,
    show: enrolled,
    remedies: () => [],
    stop: () => ended.abort(),
  });
}

function enrolled(id, answer, { drop }) {
  const photos = drop().map((each, index) =>
    h("li", {}, each, ` Photo ${index + 1}: ${answer.images[index]?.status ?? "used"}`),
  );
  return h(
    "div",
    { class: "verdict accept", tabindex: "-1" },
    h("p", { class: "verdict-word" }, answer.replaced ? "Enrolled again" : "Enrolled"),
    h("ol", { class: "used", "aria-label": "Photos used" }, photos),
    facts([
      ["Person", id],
      ["Photos used", String(answer.images.length)],
      ["Earlier enrollment", answer.replaced ? "replaced" : "none"],
      ["Holder key", answer.holder_key ? "needed at every verification" : null],
    ]),
    h("p", { class: "row" }, h("a", { href: `#/verify/${encodeURIComponent(id)}` }, "Verify this person")),
    h("p", { class: "fine" }, "Template ", h("code", {}, answer.template_id)),
  );
}
