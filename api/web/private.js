// Private mode: the package's login element takes the photos, embeds and lifts them here, and sends a template alone. This
// module is fetched only where the service serves its pack.

import { h, newId } from "./dom.js";
import { BASE, may, session } from "./service.js";
import { lacking } from "./words.js";

const ON = "This browser finds the face, embeds and lifts it. It sends only the private template: no photo, no embedding.";
const OFF = "Photos are sent to the service, which keeps none.";
// Of an enrollment.
export const STEPS = [
  "This browser finds the face, and says at once whether a photo will do.",
  "The model runs here: the faces become one embedding, and that becomes a set which holds decoys as well.",
  "Only that set is sent, and stored, encrypted. Photos and embedding never leave this browser.",
];

const runtime = await import("./client/ort.wasm.min.mjs");
// More threads need a page that is isolated.
runtime.env.wasm.numThreads = 1;
session.client.defineLogin();

// One state for the tab, until sign-out.
let on = true;

export function forget() {
  on = true;
  document.documentElement.dataset.lifting = "no";
}

// Why private mode cannot serve this, or null.
function whyNot(action, level) {
  const { contract, own } = session;
  if (!isSecureContext) return "Private mode needs HTTPS or localhost.";
  if (!may("embeddings")) return lacking("embeddings");
  if (!contract.recorded.detector) return "Private mode is not possible here: the pack has no detector to find a face with.";
  if (!contract.generator) return "Private mode is not possible here: the decoys are faces that stay secret.";
  if (action === "enroll") {
    return contract.template_enrollment ? null : "Private mode is off: this tenant may not enroll lifted templates.";
  }
  if (own.liveness !== "off") return "Private mode is off: this service checks liveness, which takes photos.";
  // The client lifts to the largest dimension that is calibrated.
  const calibrated = contract.calibrations.filter(({ mode }) => mode === "s2s");
  const most = Math.max(...calibrated.map(({ probe_m }) => probe_m));
  const served = calibrated.some(
    ({ probe_m, levels }) => probe_m === most && levels.some(({ name }) => name === level),
  );
  return served ? null : "Private mode cannot serve this level: it is not calibrated for lifted probes.";
}

// The switch of a view, and the element that takes the place of its photos. `authorize()` resolves to {subject, token} and
// is called for each attempt, `onresult` with its answer, `onerror` with its error; `onchange` where it is switched.
export function privateMode(action, { authorize, onchange, onresult, onerror }) {
  const words = h("p", { id: newId("private-hint"), role: "status" });
  const box = h("input", {
    type: "checkbox",
    role: "switch",
    id: newId("private"),
    "aria-describedby": words.id,
    onchange: () => {
      on = box.checked;
      onchange();
    },
  });
  const login = h("veilface-login", {
    service: BASE,
    action,
    "onveilface-result": ({ detail }) => onresult(detail),
    "onveilface-error": ({ detail }) => onerror(detail),
  });
  // The page itself says how it ended.
  Object.assign(login, { options: { runtime }, authorize, words: { take: "Verify", accept: "", enrolled: "" } });
  let why = null;
  const active = () => on && why === null;

  // What the visitor is about to do: verify at this level, or enroll.
  function at(level) {
    why = whyNot(action, level);
    box.checked = active();
    box.disabled = why !== null;
    login.hidden = !active();
    if (!active()) login.reset();
    words.className = why ? "off" : "hint";
    words.textContent = why ? `${why} ${OFF}` : on ? ON : OFF;
    document.documentElement.dataset.lifting = active() ? "yes" : "no";
  }

  const check = h("p", { class: "check" }, box, h("label", { for: box.id }, "Private mode"));
  return { login, root: h("div", { class: "private" }, check, words), active, at };
}
