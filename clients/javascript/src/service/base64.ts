/** Bytes as text, and back. */

export function base64(bytes: Uint8Array): string {
  let text = "";
  // A call with all of them as arguments would overflow the stack.
  for (let at = 0; at < bytes.length; at += 8192) {
    text += String.fromCharCode(...bytes.subarray(at, at + 8192));
  }
  return btoa(text);
}

/** Without padding, in the alphabet that needs no escapes in URLs and headers. */
export function base64url(bytes: Uint8Array): string {
  return base64(bytes).replaceAll("+", "-").replaceAll("/", "_").replace(/=+$/, "");
}
