/** Keys that holders of enrollments keep: made here, sent with a call, and kept by nobody else. */

import { base64url } from "./base64.js";

const KEY_BYTES = 32;

/** Make a key for one enrollment. Keep it where only the person, or their device, gets at it. */
export function newHolderKey(): Uint8Array {
  return crypto.getRandomValues(new Uint8Array(KEY_BYTES));
}

/** The field of a request; nothing where there is no key. The error does not repeat it. */
export function holderKeyField(key: Uint8Array | undefined): { holder_key?: string } {
  if (key === undefined) return {};
  if (key.length !== KEY_BYTES) {
    throw new RangeError(`a holder key is ${KEY_BYTES} bytes: make one with newHolderKey()`);
  }
  return { holder_key: base64url(key) };
}
