// The holder key, from a passkey: without it a locked enrollment matches nobody. It is in memory for one request and
// nowhere else.

import { h, newId } from "./dom.js";
import { session } from "./service.js";

const WORDS = {
  enroll: ["Lock to a passkey", "Every verification will ask for this passkey. If it is lost, enroll the person again."],
  verify: ["Use the passkey", "Your browser asks for the passkey that the enrollment is locked to."],
};

// The switch for an enrollment, which makes the passkey first, or for a verification, which `showLock` sets where this
// key may know whether a person's enrollment is locked.
export function holderKey(action, onchange) {
  const [label, hint] = WORDS[action];
  const off = session.client
    ? session.client.whyNoPasskey()
    : "Passkeys are not offered: this service was installed without the client that they need (make javascript).";
  const ended = new AbortController();
  const note = h("p", { class: "hint", id: newId("holder"), role: "status" }, off ?? hint);
  const box = h("input", {
    type: "checkbox",
    id: newId("holder"),
    disabled: Boolean(off),
    "aria-describedby": note.id,
    onchange,
  });
  // Another attempt to enroll takes the same passkey.
  let made = null;

  function showLock(person) {
    if (action !== "verify") return;
    const locked = person?.holder_key ?? false;
    // About a person who is not enrolled, the visitor's choice stands.
    if (person) box.checked = locked && !off;
    note.textContent = `${locked ? "This enrollment is locked to a holder key. " : ""}${off ?? hint}`;
    // What is set by itself is not left folded away.
    if (locked) box.closest("details")?.setAttribute("open", "");
  }

  // `say` tells the visitor what is waited for. Resolves to the key as text, or null.
  async function key(id, say) {
    if (!box.checked) return null;
    say("Waiting for the passkey…");
    const { base64url, createPasskey, passkeyHolderKey } = session.client;
    if (action === "enroll" && made?.subject !== id) made = await createPasskey(id, ended.signal);
    try {
      return base64url(await passkeyHolderKey(id, ended.signal, made ?? undefined));
    } catch (error) {
      if (error.code === "passkey_unsupported") made = null;
      throw error;
    }
  }

  const check = h("p", { class: "check" }, box, h("label", { for: box.id }, label));
  return { parts: [check, note], wanted: () => box.checked, showLock, key, stop: () => ended.abort() };
}
