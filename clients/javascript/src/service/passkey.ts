/**
 * A holder key from a passkey, by WebAuthn's PRF extension: the same passkey gives the same key, here
 * as on the service's own page (docs/javascript.md "The holder key").
 */

import { VeilfaceError } from "../errors.js";

// With another label every passkey would give another key.
const LABEL = "Veilface holder key 1: ";

/** A passkey that was just made; its key is asked for by {@link passkeyHolderKey}. */
export interface Passkey {
  readonly id: ArrayBuffer;
  readonly subject: string;
}

const random = (count: number): Uint8Array<ArrayBuffer> =>
  crypto.getRandomValues(new Uint8Array(count));
const labelled = (subject: string): Uint8Array<ArrayBuffer> =>
  new TextEncoder().encode(LABEL + subject.normalize("NFC"));
const saltOf = async (subject: string): Promise<Uint8Array<ArrayBuffer>> =>
  new Uint8Array(await crypto.subtle.digest("SHA-256", labelled(subject)));

const unsupported = (why = "This passkey, or this browser, cannot make a key (no PRF extension)."): VeilfaceError =>
  new VeilfaceError("passkey_unsupported", why);

/** Make a passkey for a subject, under the name of the page's host. Earlier ones stay. */
export async function createPasskey(subject: string, signal: AbortSignal): Promise<Passkey> {
  const publicKey: PublicKeyCredentialCreationOptions = {
    rp: { name: location.hostname },
    // Ends in the salt, by which a passkey of another subject is known.
    user: { id: Uint8Array.of(...random(16), ...(await saltOf(subject))), name: subject, displayName: subject },
    // Nobody checks a signature: what counts is the key.
    challenge: random(32),
    pubKeyCredParams: [-7, -257].map((alg) => ({ type: "public-key", alg })),
    authenticatorSelection: { residentKey: "required", userVerification: "required" },
    extensions: { prf: {} },
  };
  const made = await prompted(() => navigator.credentials.create({ publicKey, signal }));
  if (made.getClientExtensionResults().prf?.enabled !== true) throw unsupported();
  return { id: made.rawId, subject };
}

/** Compute the holder key, 32 bytes, by the passkey `made`, or by one that the person chooses. */
export async function passkeyHolderKey(subject: string, signal: AbortSignal, made?: Passkey): Promise<Uint8Array> {
  const salt = await saltOf(subject);
  const publicKey: PublicKeyCredentialRequestOptions = {
    challenge: random(32),
    userVerification: "required",
    allowCredentials: made ? [{ type: "public-key", id: made.id }] : [],
    extensions: { prf: { eval: { first: salt } } },
  };
  const used = await prompted(() => navigator.credentials.get({ publicKey, signal }));
  const { userHandle } = used.response as AuthenticatorAssertionResponse;
  if (userHandle && String(new Uint8Array(userHandle).slice(-32)) !== String(salt)) {
    throw new VeilfaceError("passkey_of_another", `This passkey is not for ${subject}.`);
  }
  const secret = used.getClientExtensionResults().prf?.results?.first;
  if (secret === undefined) throw unsupported();
  const material = await crypto.subtle.importKey("raw", secret, "HKDF", false, ["deriveBits"]);
  const how = { name: "HKDF", hash: "SHA-256", salt: new Uint8Array(32), info: labelled(subject) };
  return new Uint8Array(await crypto.subtle.deriveBits(how, material, 256));
}

/** Why this page cannot use passkeys, or undefined where it can. */
export function whyNoPasskey(): string | undefined {
  if (!isSecureContext) return "Browsers allow passkeys only over HTTPS or on localhost.";
  if (/^[\d.]+$|:/.test(location.hostname)) {
    return "Passkeys belong to a host name, not to an IP address: on this machine, open the page at localhost.";
  }
  return globalThis.PublicKeyCredential ? undefined : "This browser has no passkeys.";
}

async function prompted(ask: () => Promise<Credential | null>): Promise<PublicKeyCredential> {
  const why = whyNoPasskey();
  if (why !== undefined) throw unsupported(why);
  let used: Credential | null = null;
  try {
    used = await ask();
  } catch (error) {
    const { name } = error as Error;
    if (name === "AbortError") throw error;
    if (name !== "NotAllowedError") throw unsupported();
  }
  if (used === null) {
    throw new VeilfaceError("passkey_refused", "No passkey was used: cancelled, timed out, or there is none here.");
  }
  return used as PublicKeyCredential;
}
