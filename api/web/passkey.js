// A holder key from a passkey, by WebAuthn's PRF extension: the same passkey gives the same key.

import { Problem } from "./service.js";

// With another label every passkey would give another key (docs/web-page.md "The holder key").
const LABEL = "Veilface holder key 1: ";

export const random = (count) => crypto.getRandomValues(new Uint8Array(count));
const labelled = (id) => new TextEncoder().encode(LABEL + id);
const saltOf = async (id) => new Uint8Array(await crypto.subtle.digest("SHA-256", labelled(id)));
export const base64url = (raw) =>
  btoa(String.fromCharCode(...raw)).replaceAll("+", "-").replaceAll("/", "_").replace("=", "");

// Why this page cannot use passkeys, or null.
export function whyNoPasskey() {
  if (!isSecureContext) return "Browsers allow passkeys only over HTTPS or on localhost.";
  if (/^\[|^[\d.]+$/.test(location.hostname)) {
    return "Passkeys belong to a name, not to an IP address: on this machine, open this page at localhost instead.";
  }
  return window.PublicKeyCredential ? null : "This browser has no passkeys.";
}

const unsupported = () =>
  new Problem({ code: "passkey_unsupported", message: "this passkey, or this browser, cannot make a key (no PRF extension)" });

// Cancelled, too late and not there are one answer: the browser does not tell them apart.
async function prompt(asking) {
  try {
    return await asking;
  } catch (error) {
    if (error.name === "AbortError") throw error;
    if (error.name !== "NotAllowedError") throw unsupported();
    const message = "no passkey was used: cancelled, timed out, or there is none here";
    throw new Problem({ code: "passkey_refused", message });
  }
}

// A passkey for this id. Earlier ones stay: the enrollment may yet fail, and theirs is then in force.
export async function create(id, signal) {
  const publicKey = {
    rp: { name: "Veilface" },
    // Ends in the salt, by which a passkey of another id is known.
    user: { id: new Uint8Array([...random(16), ...(await saltOf(id))]), name: id, displayName: id },
    // Nobody checks a signature: what counts is the key.
    challenge: random(32),
    pubKeyCredParams: [-7, -257].map((alg) => ({ type: "public-key", alg })),
    authenticatorSelection: { residentKey: "required", userVerification: "required" },
    extensions: { prf: {} },
  };
  const made = await prompt(navigator.credentials.create({ publicKey, signal }));
  if (!made.getClientExtensionResults().prf?.enabled) throw unsupported();
  return made.rawId;
}

// The key, from the passkey `made`, or from one that the visitor chooses.
export async function derive(id, signal, made = null) {
  const salt = await saltOf(id);
  const publicKey = {
    challenge: random(32),
    userVerification: "required",
    allowCredentials: made ? [{ type: "public-key", id: made }] : [],
    extensions: { prf: { eval: { first: salt } } },
  };
  const used = await prompt(navigator.credentials.get({ publicKey, signal }));
  const { userHandle } = used.response;
  if (userHandle && `${new Uint8Array(userHandle).slice(-32)}` !== `${salt}`) {
    throw new Problem({ code: "passkey_of_another", message: `this passkey is not for ${id}` });
  }
  const secret = used.getClientExtensionResults().prf?.results?.first;
  if (!secret) throw unsupported();
  const material = await crypto.subtle.importKey("raw", secret, "HKDF", false, ["deriveBits"]);
  const how = { name: "HKDF", hash: "SHA-256", salt: new Uint8Array(32), info: labelled(id) };
  return base64url(new Uint8Array(await crypto.subtle.deriveBits(how, material, 256)));
}
