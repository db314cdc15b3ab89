// The holder key: without it a locked enrollment matches nobody. It comes from a passkey or from a
// file, and is in memory for one request and nowhere else.

import { download, field, h, newId } from "./dom.js";
import { base64url, create, derive, random, whyNoPasskey } from "./passkey.js";
import { Problem, call, may, subjectPath } from "./service.js";

// 32 bytes in base64url; the last digit has four bits.
const KEY = /^[A-Za-z0-9_-]{42}[AEIMQUYcgkosw048]$/;

async function read(file) {
  const text = file && file.size < 100 ? (await file.text().catch(() => "")).trim() : "";
  if (KEY.test(text)) return text;
  throw new Problem({ code: "key_file", message: file ? "that is no key file" : "no key file is chosen" });
}

// `fromPasskey(id, signal)` gives the key; `labels` and `hints` say what the choices mean here.
function choice({ labels, hints, fromPasskey, onchange, maker = null }) {
  const off = whyNoPasskey();
  const name = newId("holder");
  const ended = new AbortController();
  const file = h("input", { type: "file", required: true });
  const panels = {
    none: [],
    passkey: [h("p", { class: "hint" }, hints.passkey)],
    file: [maker, field("Key file", file, hints.file)].filter(Boolean),
  };
  const panel = h("div", {});
  const told = h("p", { class: "hint", role: "status" });
  const radios = Object.keys(panels).map((value) =>
    h("input", {
      type: "radio",
      name,
      id: newId("holder"),
      value,
      checked: value === "none",
      disabled: value === "passkey" && off !== null,
      "aria-describedby": value === "passkey" && off ? `${name}-off` : null,
      onchange: () => {
        choose(value);
        onchange();
      },
    }),
  );
  const chosen = () => radios.find((each) => each.checked).value;

  function choose(value) {
    radios.find((each) => each.value === value).checked = true;
    panel.replaceChildren(...panels[value]);
  }

  // `say` is told what the visitor is waited for.
  async function key(id, say) {
    const from = chosen();
    if (from === "none") return null;
    if (from === "passkey") say("Waiting for the passkey…");
    try {
      return await (from === "file" ? read(file.files[0]) : fromPasskey(id, ended.signal));
    } finally {
      // Whoever comes next has a file of their own.
      file.value = "";
    }
  }

  const root = h(
    "fieldset",
    { class: "choice" },
    h("legend", {}, "Holder key"),
    radios.map((each) => h("span", {}, each, h("label", { for: each.id }, labels[each.value]))),
  );
  const parts = [root, off ? h("p", { class: "hint", id: `${name}-off` }, off) : null, told, panel];
  return { parts, key, told, chosen, choose, signal: ended.signal, stop: () => ended.abort() };
}

// For an enrollment: the passkey, or the file, is made first.
export function newHolderKey(subject, onchange) {
  // Another attempt takes the same passkey.
  let made = null;
  const said = h("p", { class: "hint", role: "status" });
  const make = () => {
    download(`${subject.value || "veilface"}.holder-key.txt`, `${base64url(random(32))}\n`, "text/plain");
    said.textContent = "The file is with your downloads. Choose it here.";
  };
  return choice({
    labels: {
      none: "None",
      passkey: "Lock to a passkey",
      file: "Lock to a key file",
    },
    hints: {
      passkey: "Every verification will ask for this passkey. Nobody can restore it: if it is lost, enroll again.",
      file: "Every verification will ask for this file. Keep it safe: if it is lost, enroll again.",
    },
    maker: h("div", {}, h("button", { type: "button", class: "secondary", onclick: make }, "Make a key file"), said),
    onchange,
    async fromPasskey(id, signal) {
      if (made?.id !== id) made = { id, passkey: await create(id, signal) };
      return derive(id, signal, made.passkey).catch((error) => {
        if (error.code === "passkey_unsupported") made = null;
        throw error;
      });
    },
  });
}

// For a verification: chosen by itself where this key may know that the enrollment is locked.
export function holderKey(subject, onchange) {
  const asked = choice({
    labels: { none: "None", passkey: "Passkey", file: "Key file" },
    hints: {
      passkey: "Your browser will ask for the passkey.",
      file: "The file that was made for this enrollment.",
    },
    fromPasskey: derive,
    onchange,
  });
  const { told } = asked;
  let known = null;

  async function learn() {
    told.textContent = "";
    const id = subject.value;
    if (!id || !subject.validity.valid || !may("enroll")) return;
    // Who is not enrolled, or cannot be asked about now, is verified as the visitor chose.
    const about = await call("GET", subjectPath(id), { signal: asked.signal }).catch(() => null);
    if (!about || subject.value !== id) return;
    told.textContent = about.holder_key ? "This enrollment is locked to a holder key." : "";
    if (!about.holder_key) asked.choose("none");
    else if (asked.chosen() === "none") asked.choose(whyNoPasskey() ? "file" : "passkey");
  }

  const start = () => (known = learn());
  subject.addEventListener("change", start);
  start();
  return {
    ...asked,
    async key(id, say) {
      await known;
      return asked.key(id, say);
    },
  };
}
