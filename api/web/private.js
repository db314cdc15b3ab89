// Private mode: this page finds, aligns and embeds the face, and sends a lifted template alone. It is
// fetched only where the service serves its pack.

import { h, newId } from "./dom.js";
import { BASE, Problem, call, may, session, untilSignedOut } from "./service.js";
import { lacking } from "./words.js";

// The graphs are fetched before anybody is named: their token is of a subject that nobody is.
const NOBODY = "private-mode";
const TRIES = 3;

const ON = "This browser finds the face, embeds and lifts it. It sends only the private template: no photo, no embedding.";
const OFF = "Photos are sent to the service, which keeps none.";
const DROPPED = "The photos that were chosen in private mode are removed. ";
const LOADING = "Loading the model into this browser, which keeps it for the next visit…";
// Of an enrollment.
export const STEPS = [
  "This browser finds the face in each photo and says at once whether the photo will do.",
  "The model runs here: the faces become one embedding, and that becomes a set which holds decoys as well.",
  "Only that set is sent, and stored, encrypted. Photos and embedding never leave this browser.",
];

// One state for the tab, until sign-out.
let on = true;
// The switch of the view that is open.
let current = null;
// The client whose graphs are loaded or on their way.
let prepared = null;
// Two lifts of one embedding give it away: lifts by action and photos, and what each photo was lifted for.
let lifts = new Map();
let purposes = new Map();

// At sign-out: the next one to sign in begins anew.
export function forget() {
  on = true;
  document.documentElement.dataset.lifting = "no";
  prepared = null;
  [lifts, purposes] = [new Map(), new Map()];
}

// Why private mode cannot serve this, or null.
function whyNot(action, level) {
  const { contract, own } = session;
  if (!session.client) {
    return "Private mode is not offered: this service was installed without the client that it needs (make javascript).";
  }
  if (!isSecureContext) return "Private mode needs HTTPS or localhost.";
  if (!may("embeddings")) return lacking("embeddings");
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

// The switch for a view. `at(level, picker)` says what the visitor is about to do; `onchange` that it is switched.
export function offer(action, onchange) {
  const told = h("p", { class: "hint", id: newId("private-hint"), role: "status" });
  const box = h("input", {
    type: "checkbox",
    role: "switch",
    id: newId("private"),
    "aria-describedby": told.id,
    onchange: () => {
      on = box.checked;
      dropFailed();
      onchange();
    },
  });
  const offered = { action, why: "", root: null, at, say };
  let dropped = "";

  function at(level, picker) {
    const before = active();
    offered.why = whyNot(action, level);
    dropped = "";
    if (before && !active() && picker) {
      // Nothing that was taken under the promise is sent without it.
      picker.start();
      if (picker.drop(picker.chosen()).length) dropped = DROPPED;
    }
    box.checked = active();
    box.disabled = offered.why !== null;
    told.className = offered.why ? "off" : "hint";
    document.documentElement.dataset.lifting = active() ? "yes" : "no";
    say();
  }

  function say(text = null) {
    const words = text ?? (offered.why ? `${offered.why} ${dropped}${OFF}` : on ? ON : OFF);
    if (told.textContent !== words) told.textContent = words;
  }

  const check = h("p", { class: "check", hidden: !session.client }, box, h("label", { for: box.id }, "Private mode"));
  offered.root = h("div", { class: "private" }, check, told);
  current = offered;
  dropFailed();
  return offered;
}

export const active = () => on && current?.why === null;

// A view that is opened, or the switch, has it tried again; the looks of a camera do not.
function dropFailed() {
  if (prepared?.failed) prepared = null;
}

const token = async (json, signal) => (await call("POST", "/v1/tokens", { json, signal })).token;

function ready() {
  const until = untilSignedOut();
  if (prepared?.until === until) return prepared.client;
  const offered = current;
  offered.say(LOADING);
  const loading = { until, failed: false, client: load(until, offered.action) };
  prepared = loading;
  loading.client
    .catch(() => (loading.failed = true))
    .then(() => offered.say());
  return loading.client;
}

async function load(signal, action) {
  const runtime = await import("./client/ort.wasm.min.mjs").catch(() => {
    throw new Problem({ code: "private_mode", message: "what private mode runs could not be loaded" });
  });
  // More need a page that is isolated.
  runtime.env.wasm.numThreads = 1;
  for (let tries = 1; ; tries++) {
    signal.throwIfAborted();
    const bearer = await token({ subject_id: NOBODY, action }, signal);
    const client = new session.client.PrivateClient(BASE, bearer, { runtime, signal });
    try {
      await client.prepare();
      signal.addEventListener("abort", () => void client.close());
      return client;
    } catch (error) {
      await client.close();
      // A slow download outlives its token; what has come is in the browser's cache.
      if (error.code !== "replayed" || tries === TRIES) throw error;
    }
  }
}

// The errors of the client, as those of a call. What the page finds out by itself has the status that the
// service would have given it.
function problemOf(error, photos = 1) {
  const { name, code, status, details, image, requestId = null, retryAfter = null } = error;
  if (error instanceof Problem || name === "AbortError") return error;
  const message = error.message.charAt(0).toLowerCase() + error.message.slice(1);
  if (name === "PhotoError") {
    const which = image !== undefined && photos > 1 ? `photo ${image + 1} of ${photos}: ` : "";
    return new Problem({ status: 422, code, message: which + message, details: { ...details, image } });
  }
  if (name === "ConnectionFailed" || String(code).startsWith("http_")) {
    return new Problem({ status, code: "unreachable", message: "the service does not respond" });
  }
  if (name === "ServiceError") return new Problem({ status, code, message, details, requestId, wait: retryAfter });
  return new Problem({ code: "private_mode", message: `private mode does not work here: ${message}` });
}

// What the service's check would answer; nothing is sent of the photo.
export async function check(photo, face, signal) {
  try {
    const client = await ready();
    signal?.throwIfAborted();
    return await client.check(photo, { face: face || undefined });
  } catch (error) {
    throw problemOf(error);
  }
}

async function nameOf(photo) {
  const hash = await crypto.subtle.digest("SHA-256", await photo.arrayBuffer());
  return String(new Uint8Array(hash));
}

// The lift of these photos for this action: made once, whatever they are chosen by and in what order.
async function lifted(client, action, photos, face, until) {
  const names = await Promise.all(photos.map(nameOf));
  until.throwIfAborted();
  const image = names.findIndex((name) => (purposes.get(name) ?? action) !== action);
  if (image >= 0) {
    const before = action === "verify" ? "to enroll" : "to verify";
    const message = `this photo was used ${before} already, and a second lift of it would give its embedding away`;
    throw new Problem({ status: 422, code: "lifted_before", message, details: { image } });
  }
  const all = JSON.stringify([action, ...[...new Set(names)].sort()]);
  if (!lifts.has(all)) {
    // Before it is waited for: another view may have the same photos meanwhile.
    for (const name of names) purposes.set(name, action);
    const given = { face: face || undefined };
    const lift = action === "enroll" ? client.liftEnrollment(photos, given) : client.lift(photos, given);
    lifts.set(all, lift);
    lift.catch(() => {
      if (lifts.get(all) !== lift) return;
      lifts.delete(all);
      const rest = new Set([...lifts.keys()].flatMap((key) => JSON.parse(key)));
      for (const name of names) if (!rest.has(name)) purposes.delete(name);
    });
  }
  const lift = await lifts.get(all);
  until.throwIfAborted();
  return lift;
}

async function attempt({ photos, face, ...asked }, send) {
  const until = untilSignedOut();
  dropFailed();
  try {
    const client = await ready();
    until.throwIfAborted();
    const lift = await lifted(client, asked.action, photos, face, until);
    const one = client.as(await token(asked, until));
    try {
      return await send(one, lift);
    } finally {
      await one.close();
    }
  } catch (error) {
    until.throwIfAborted();
    // The photos that are chosen next are lifted for the contract in force.
    if (error.code === "contract_mismatch") prepared = null;
    throw problemOf(error, photos.length);
  }
}

const holder = (key) =>
  key && { holderKey: Uint8Array.from(atob(key.replaceAll("-", "+").replaceAll("_", "/")), (each) => each.charCodeAt(0)) };

export const verify = (name, { photos, face, level, holder_key }) =>
  attempt({ subject_id: name, action: "verify", level, photos, face }, (client, lift) =>
    client.verify(name, lift, { ...holder(holder_key) }),
  );

// `replaces` is the template that may be replaced, or null.
export const enroll = (name, { photos, face, holder_key }, replaces) =>
  attempt({ subject_id: name, action: "enroll", photos, face }, async (client, lift) => {
    return await client.enroll(name, lift, { replace: replaces ?? false, ...holder(holder_key) });
  });
