import { facts, h, openDialog, workbench } from "./dom.js";
import { holderKey } from "./holder.js";
import { photoPicker } from "./photos.js";
import { call, form, session, subjectPath } from "./service.js";
import { SPELLING, offNote, subjectField, switchOf, whyOff } from "./subject.js";
import { problemBox } from "./words.js";

const STEPS = [
  "The service finds the face in each photo and says at once whether the photo will do.",
  "Your model turns the faces into one embedding, which is hidden in a set that holds decoys as well.",
  "Only that set is stored, encrypted. Photos and embedding are forgotten.",
];

export function enrollView(id) {
  const why = whyOff("enroll");
  const [subject, subjectPart] = subjectField(id, `A new id (${SPELLING}), or whom to enroll again.`);
  const result = h("div", { class: "result" });
  let dialog = null;
  const holder = holderKey("enroll", subject, () => result.replaceChildren());
  const send = h("button", { type: "submit", disabled: true }, "Enroll");
  const say = (text) => (send.textContent = text);
  const picker = why
    ? null
    : photoPicker({
        most: 10,
        onchange: (ready) => {
          send.disabled = !ready;
          result.replaceChildren();
        },
      });

  const mode = why === null ? session.mode?.offer("enroll", showSteps) : null;
  function showSteps() {
    mode?.at();
    const words = session.mode?.active() ? session.mode.STEPS : STEPS;
    steps.forEach((step, index) => (step.textContent = words[index]));
  }

  // The service says whom it would replace, and replaces nobody else: so nothing is replaced unasked.
  async function put(name, send) {
    try {
      return await send(null);
    } catch (error) {
      const known = error.code === "enrollment_conflict" && error.details.template_id;
      if (!known) throw error;
      return (await mayReplace(name)) ? await send(known) : null;
    }
  }

  // `replaces` is the template that may be replaced, or null.
  const sender = (name, photos, given) => (replaces) =>
    call("PUT", `${subjectPath(name)}/enrollment`, {
      body: form("images", photos, given),
      headers: replaces ? { "If-Match": `"${replaces}"` } : { "If-None-Match": "*" },
    });

  function mayReplace(name) {
    const close = (value) => () => dialog.close(value);
    dialog = openDialog(
      `Replace ${name}’s enrollment?`,
      "This person is enrolled already. Enrolling again replaces their template and its lock.",
      h(
        "p",
        { class: "row" },
        h("button", { type: "button", class: "secondary", onclick: close("keep") }, "Keep"),
        h("button", { type: "button", class: "danger", onclick: close("replace") }, "Replace"),
      ),
    );
    const opened = dialog;
    return new Promise((resolve) => {
      opened.addEventListener("close", () => resolve(opened.returnValue === "replace"));
    });
  }

  async function submit(event) {
    event.preventDefault();
    if (fields.disabled) return;
    // The answer is about this person and these photos, whatever else is chosen when it comes.
    const name = subject.value;
    const sent = picker.chosen();
    const [photos, face, lifts] = [picker.blobs(), picker.face(), session.mode?.active()];
    fields.disabled = true;
    result.replaceChildren();
    try {
      const holder_key = await holder.key(name, say);
      say("Enrolling…");
      const answer = await put(
        name,
        lifts
          ? (replaces) => session.mode.enroll(name, { photos, face, holder_key }, replaces)
          : sender(name, photos, { face, holder_key }),
      );
      fields.disabled = false;
      if (answer) {
        const shown = enrolled(name, answer, picker.drop(sent));
        // The field says who is enrolled.
        subject.dispatchEvent(new Event("input"));
        result.replaceChildren(shown);
        if (lifts && root.isConnected) result.append(session.mode.whatLeft());
        shown.focus();
      }
    } catch (error) {
      fields.disabled = false;
      if (error.details) picker.blame(error, sent);
      result.replaceChildren(problemBox(error));
      if (lifts && root.isConnected) result.append(session.mode.whatLeft());
      result.scrollIntoView({ block: "nearest" });
    }
    say("Enroll");
    send.disabled = !picker.ready();
    if (document.activeElement === document.body) send.focus();
  }

  const fields = h(
    "fieldset",
    { class: "plain", disabled: why !== null },
    subjectPart,
    switchOf(mode),
    picker?.root ?? null,
    holder.parts,
    send,
  );

  const entry = h("form", { class: "card", onsubmit: submit }, fields);
  const steps = STEPS.map(() => h("span", {}));
  showSteps();
  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, "Enroll"),
    h(
      "p",
      { class: "lead" },
      "One to ten photos of a person become one private template. ",
      "Whoever is enrolled already is replaced only if you confirm it.",
    ),
    offNote(why),
    workbench(entry, "What happens to the photos", steps, result),
  );
  picker?.dropOn(entry);
  return {
    root,
    stop() {
      dialog?.close();
      holder.stop();
      picker?.stop();
    },
  };
}

function enrolled(id, answer, thumbs) {
  return h(
    "div",
    { class: "verdict accept", role: "status", tabindex: "-1" },
    h("p", { class: "verdict-word" }, answer.replaced ? "Enrolled again" : "Enrolled"),
    h(
      "ol",
      { class: "used", "aria-label": "Photos used" },
      thumbs.map((each, index) => h("li", {}, each, ` Photo ${index + 1}: ${answer.images[index]?.status ?? "used"}`)),
    ),
    facts([
      ["Person", id],
      ["Photos used", String(answer.images.length)],
      ["Earlier enrollment", answer.replaced ? "replaced" : "none"],
      ["Holder key", answer.holder_key ? "needed at every verification" : null],
    ]),
    h(
      "p",
      { class: "row" },
      h("a", { href: `#/verify/${encodeURIComponent(id)}` }, "Verify this person"),
    ),
    h("p", { class: "fine" }, "Template ", h("code", {}, answer.template_id)),
  );
}
