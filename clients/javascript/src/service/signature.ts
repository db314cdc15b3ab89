/** Signatures of lifted probes (docs/rest.md "Signed probes"), by WebCrypto. */

import { hex, sha256 } from "../models/pack.js";
import { base64, randomText } from "./base64.js";

const API_KEY = /^vf_[0-9a-f]{12}_([0-9a-f]{64})$/;
const TOKEN = /^vft_[A-Za-z0-9_-]{8,600}$/;

/** Whether a bearer is a token of one call (docs/rest.md "Tokens"), and no API key. */
export const isToken = (bearer: string): boolean => TOKEN.test(bearer);

/** Whether probes can be signed with a bearer. */
export const canSign = (bearer: string): boolean => API_KEY.test(bearer) || isToken(bearer);

/** The body of a verification by a template. */
export interface SignedProbe {
  readonly template: string;
  readonly nonce: string;
  readonly timestamp: number;
  readonly hmac: string;
  readonly level?: string;
}

/** Sign a probe for one subject and level; each call draws another nonce where none is given. */
export async function signedProbe(
  bearer: string,
  subject: string,
  template: Uint8Array,
  {
    level,
    nonce = randomText(18),
    timestamp = Math.floor(Date.now() / 1000),
  }: { level?: string | undefined; nonce?: string; timestamp?: number } = {},
): Promise<SignedProbe> {
  const lines = [
    "veilface-probe-1",
    subject,
    level ?? "",
    "template",
    await sha256(template),
    nonce,
    String(timestamp),
  ];
  const text = new TextEncoder().encode(lines.join("\n"));
  const signed = await crypto.subtle.sign("HMAC", await probeKey(bearer), text);
  return {
    template: base64(template),
    nonce,
    timestamp,
    hmac: hex(new Uint8Array(signed)),
    ...(level !== undefined && { level }),
  };
}

/** HKDF-SHA256 of the secret of an API key, or of a token's whole text. */
async function probeKey(bearer: string): Promise<CryptoKey> {
  const secret = API_KEY.exec(bearer)?.[1];
  if (secret === undefined && !isToken(bearer)) {
    throw new RangeError("only an API key (vf_…) or a token (vft_…) of the service signs probes");
  }
  const material =
    secret === undefined
      ? new TextEncoder().encode(bearer)
      : Uint8Array.from(secret.match(/../g) ?? [], (byte) => parseInt(byte, 16));
  const base = await crypto.subtle.importKey("raw", material, "HKDF", false, ["deriveKey"]);
  return crypto.subtle.deriveKey(
    {
      name: "HKDF",
      hash: "SHA-256",
      salt: new Uint8Array(32),
      info: new TextEncoder().encode("veilface/1/probe-key"),
    },
    base,
    { name: "HMAC", hash: "SHA-256", length: 256 },
    false,
    ["sign"],
  );
}
