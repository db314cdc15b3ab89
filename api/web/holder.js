// The holder key: without it a locked enrollment matches nobody. It comes from a passkey or from a
// file, and is in memory for one request and nowhere else.

import { download, field, h, newId } from "./dom.js";
import { Problem, call, may, session, subjectPath } from "./service.js";

// 32 bytes in base64url; the last digit has four bits.
const KEY = /^[A-Za-z0-9_-]{42}[AEIMQUYcgkosw048]$/;
const MODES = {
  enroll: {
    passkey: "Lock to a passkey",
    file: "Lock to a key file",
    passkeyHint: "Every verification will ask for this passkey. Nobody can restore it: if it is lost, enroll again.",
    fileHint: "Every verification will ask for this file. Keep it safe: if it is lost, enroll again.",
  },
  verify: {
    passkey: "Passkey",
    file: "Key file",
    passkeyHint: "Your browser will ask for the passkey.",
    fileHint: "The file that was made for this enrollment.",
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
  const words = MODES[action];
  const off = whyNoPasskey();
  const name = newId("holder");
  const ended = new AbortController();
  const file = h("input", { type: "file", required: true });
  const told = h("p", { class: "hint", role: "status" });
  const panel = h("div", {});
  const panels = {
    none: [],
    passkey: [h("p", { class: "hint" }, words.passkeyHint)],
    file: [action === "enroll" ? fileMaker(subject) : "", field("Key file", file, words.fileHint)],
  };
  const radios = Object.keys(panels).map((value) =>
    h("input", {
      type: "radio",
      name,
      id: newId("holder"),
      value,
      checked: value === "none",
      disabled: value === "passkey" && Boolean(off),
      "aria-describedby": value === "passkey" && off ? `${name}-off` : null,
      onchange: () => {
        choose(value);
        onchange();
      },
    }),
  );
  const chosen = () => radios.find((each) => each.checked).value;
  // Another attempt to enroll takes the same passkey.
  let made = null;
  let known = null;

  function choose(value) {
    radios.find((each) => each.value === value).checked = true;
    panel.replaceChildren(...panels[value]);
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
    const from = chosen();
    if (from === "none") return null;
    if (from === "passkey") say("Waiting for the passkey…");
    try {
      return await (from === "file" ? read(file.files[0]) : fromPasskey(id));
    } finally {
      // The next visitor has a file of their own.
      file.value = "";
    }
  }

  async function learn() {
    told.textContent = "";
    const id = subject.value;
    if (!id || !subject.validity.valid || !may("enroll")) return;
    // A person who is not enrolled, or cannot be asked about now, is verified as the visitor chose.
    const about = await call("GET", subjectPath(id), { signal: ended.signal }).catch(() => null);
    if (!about || subject.value !== id) return;
    told.textContent = about.holder_key ? "This enrollment is locked to a holder key." : "";
    if (!about.holder_key) choose("none");
    else if (chosen() === "none") choose(off ? "file" : "passkey");
  }

  if (action === "verify") {
    const start = () => (known = learn());
    subject.addEventListener("change", start);
    start();
  }
  const labels = { none: "None", ...words };
  const root = h(
    "fieldset",
    { class: "choice" },
    h("legend", {}, "Holder key"),
    radios.map((each) => h("span", {}, each, h("label", { for: each.id }, labels[each.value]))),
  );
  const parts = [root, off ? h("p", { class: "hint", id: `${name}-off` }, off) : null, told, panel];
  return { parts, key, stop: () => ended.abort() };
}

function fileMaker(subject) {
  const said = h("p", { class: "hint", role: "status" });
  const make = () => {
    const key = btoa(String.fromCharCode(...crypto.getRandomValues(new Uint8Array(32))));
    const text = key.replaceAll("+", "-").replaceAll("/", "_").replace("=", "\n");
    download(`${subject.value || "veilface"}.holder-key.txt`, text, "text/plain");
    said.textContent = "The file is with your downloads. Choose it here.";
  };
  return h("div", {}, h("button", { type: "button", class: "secondary", onclick: make }, "Make a key file"), said);
}
