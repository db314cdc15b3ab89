import { facts, field, h, openDialog } from "./dom.js";
import { newHolderKey } from "./holder.js";
import { photoPicker } from "./photos.js";
import { call, form, may, nonce, session, subjectPath } from "./service.js";
import { lacking, problemBox } from "./words.js";

export function subjectField(id = "") {
  const input = h("input", {
    type: "text",
    required: true,
    maxlength: "128",
    pattern: "[A-Za-z0-9._@:\\-]{1,128}",
    autocomplete: "off",
    autocapitalize: "none",
    spellcheck: "false",
    value: id,
  });
  return [input, field("Person's id", input, "1 to 128 letters, digits or . _ @ : -")];
}

// What the key, or the service, does not allow: said once, above the form that it switches off.
export function whyOff(right) {
  if (!may(right)) return lacking(right);
  if (!session.contract.photos) {
    return "This service runs without a model pack: it accepts lifted templates but no photos.";
  }
  return null;
}

export const offNote = (why) => (why ? h("p", { class: "off", role: "note" }, why) : null);

export function enrollView(id) {
  const why = whyOff("enroll");
  const [subject, subjectPart] = subjectField(id);
  const result = h("div", { class: "result" });
  let dialog = null;
  const holder = newHolderKey(subject, () => result.replaceChildren());
  const send = h("button", { type: "submit", disabled: true }, "Enroll");
  const picker = why
    ? null
    : photoPicker({
        most: 10,
        onchange: (ready) => {
          send.disabled = !ready;
          result.replaceChildren();
        },
      });

  // The service says whom it would replace, and replaces nobody else: so nothing is replaced unasked.
  async function put(name, body) {
    const send = (condition) =>
      call("PUT", `${subjectPath(name)}/enrollment`, {
        body,
        headers: { "Idempotency-Key": nonce(), ...condition },
      });
    try {
      return await send({ "If-None-Match": "*" });
    } catch (error) {
      const known = error.code === "enrollment_conflict" && error.details.template_id;
      if (!known) throw error;
      return (await mayReplace(name)) ? await send({ "If-Match": `"${known}"` }) : null;
    }
  }

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
    const [photos, face] = [picker.blobs(), picker.face()];
    fields.disabled = true;
    send.textContent = "Enrolling…";
    result.replaceChildren();
    try {
      const body = form("images", photos, { face, holder_key: await holder.key(name) });
      const answer = await put(name, body);
      fields.disabled = false;
      if (answer) {
        picker.drop(sent);
        const shown = enrolled(name, answer);
        result.replaceChildren(shown);
        shown.focus();
      }
    } catch (error) {
      fields.disabled = false;
      if (error.details) picker.blame(error, sent);
      result.replaceChildren(problemBox(error));
    }
    send.textContent = "Enroll";
    send.disabled = !picker.ready();
    if (document.activeElement === document.body) send.focus();
  }

  const fields = h(
    "fieldset",
    { class: "plain", disabled: why !== null },
    subjectPart,
    picker?.root ?? null,
    holder.parts,
    send,
  );

  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, "Enroll"),
    h(
      "p",
      { class: "lead" },
      "Your photos become one private template, which is encrypted; the photos are not kept. ",
      "Whoever is enrolled already is replaced only if you confirm it.",
    ),
    offNote(why),
    h("form", { class: "card", onsubmit: submit }, fields),
    result,
  );
  return {
    root,
    stop() {
      dialog?.close();
      holder.stop();
      picker?.stop();
    },
  };
}

function enrolled(id, answer) {
  return h(
    "div",
    { class: "verdict accept", role: "status", tabindex: "-1" },
    h("p", { class: "verdict-word" }, answer.replaced ? "Enrolled again" : "Enrolled"),
    facts([
      ["Person", id],
      ["Photos used", String(answer.images.length)],
      ["Earlier enrollment", answer.replaced ? "replaced" : "none"],
      ["Holder key", answer.holder_key ? "needed at every verification" : null],
      ["Template", h("code", {}, answer.template_id)],
    ]),
    h(
      "p",
      { class: "row" },
      h("a", { href: `#/verify/${encodeURIComponent(id)}` }, "Verify this person"),
      h("a", { href: `#/stored/${encodeURIComponent(id)}` }, "See what is stored"),
    ),
  );
}
