// The holder key: without it a locked enrollment matches nobody. It comes from a passkey or from a
// file, and is in memory for one request and nowhere else.

import { choice, download, dropZone, h, newId } from "./dom.js";
import { Problem, call, may, session, subjectPath } from "./service.js";

// 32 bytes in base64url; the last digit has four bits.
const KEY = /^[A-Za-z0-9_-]{42}[AEIMQUYcgkosw048]$/;
const WORDS = {
  enroll: {
    choices: { none: "None", passkey: "Lock to a passkey", file: "Lock to a key file" },
    passkey: "Every verification will ask for this passkey. If it is lost, enroll the person again.",
    file: "Every verification will ask for this file. If it is lost, enroll the person again.",
  },
  verify: {
    choices: { none: "None", passkey: "Passkey", file: "Key file" },
    passkey: "Your browser will ask for the passkey.",
    file: "The file that was made for this enrollment.",
  },
};

const whyNoPasskey = () =>
  session.client
    ? session.client.whyNoPasskey()
    : "Passkeys are not offered: this service was installed without the client that they need (make javascript).";

async function read(file) {
  const text = file && file.size < 100 ? (await file.text().catch(() => "")).trim() : "";
  if (KEY.test(text)) return text;
  throw new Problem({ code: "key_file", message: file ? "that is no key file" : "no key file is chosen" });
}

// The choice for an enrollment, which makes the passkey or the file first, or for a verification, which
// chooses by itself where this key may know that the enrollment is locked.
export function holderKey(action, subject, onchange) {
  const words = WORDS[action];
  const off = whyNoPasskey();
  const offId = newId("holder");
  const ended = new AbortController();
  const file = h("input", { type: "file", class: "unseen", required: true, id: newId("key") });
  const lock = h("p", { class: "hint", role: "status" });
  const panel = h("div", {});
  const panels = {
    none: [],
    passkey: [h("p", { class: "hint" }, words.passkey)],
    file: [action === "enroll" ? fileMaker(subject) : "", ...dropZone(file, "Key file", words.file)],
  };
  const source = choice("Holder key", words.choices, {
    value: "none",
    off: off ? ["passkey"] : [],
    describedby: offId,
    onchange: (value) => {
      chosen = false;
      panel.replaceChildren(...panels[value]);
      onchange();
    },
  });
  // Another attempt to enroll takes the same passkey.
  let made = null;
  let known = null;
  // Whether the choice is the page's own, for the person who was named.
  let chosen = false;

  function choose(value) {
    source.choose(value);
    panel.replaceChildren(...panels[value]);
    // What is chosen by itself is not left folded away.
    if (value !== "none") panel.closest("details")?.setAttribute("open", "");
  }

  async function fromPasskey(id) {
    const { base64url, createPasskey, passkeyHolderKey } = session.client;
    if (action === "enroll" && made?.subject !== id) made = await createPasskey(id, ended.signal);
    try {
      return base64url(await passkeyHolderKey(id, ended.signal, made ?? undefined));
    } catch (error) {
      if (error.code === "passkey_unsupported") made = null;
      throw error;
    }
  }

  // `say` tells the visitor what is waited for. Resolves to the key as text, or null.
  async function key(id, say) {
    await known;
    const from = source.value();
    if (from === "none") return null;
    if (from === "passkey") say("Waiting for the passkey…");
    try {
      return await (from === "file" ? read(file.files[0]) : fromPasskey(id));
    } finally {
      // The next visitor has a file of their own.
      file.value = "";
      file.dispatchEvent(new Event("change"));
    }
  }

  async function learn() {
    lock.textContent = "";
    if (chosen) choose("none");
    chosen = false;
    const id = subject.value;
    if (!id || !may("enroll")) return;
    // A person who is not enrolled, or cannot be asked about now, is verified as the visitor chose.
    const person = await call("GET", subjectPath(id), { signal: ended.signal }).catch(() => null);
    if (!person || subject.value !== id) return;
    lock.textContent = person.holder_key ? "This enrollment is locked to a holder key." : "";
    if (!person.holder_key) choose("none");
    else if (source.value() === "none") {
      choose(off ? "file" : "passkey");
      chosen = true;
    }
  }

  if (action === "verify") {
    const start = () => (known = learn());
    subject.addEventListener("change", start);
    start();
  }
  const parts = [source.root, off ? h("p", { class: "hint", id: offId }, off) : null, lock, panel];
  return { parts, key, stop: () => ended.abort() };
}

function fileMaker(subject) {
  const status = h("p", { class: "hint", role: "status" });
  const make = () => {
    const key = btoa(String.fromCharCode(...crypto.getRandomValues(new Uint8Array(32))));
    const text = key.replaceAll("+", "-").replaceAll("/", "_").replace("=", "\n");
    download(`${subject.value || "veilface"}.holder-key.txt`, text, "text/plain");
    status.textContent = "The file is with your downloads. Choose it here.";
  };
  return h("div", {}, h("button", { type: "button", class: "secondary", onclick: make }, "Make a key file"), status);
}
