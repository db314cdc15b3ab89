/** What the drivers share: a JSON object on stdin, a JSON object to stdout. */

export async function input() {
  const chunks = [];
  for await (const chunk of process.stdin) chunks.push(chunk);
  return JSON.parse(Buffer.concat(chunks).toString());
}

export function output(value) {
  process.stdout.write(JSON.stringify(value));
}

export const bytes = (text) => new Uint8Array(Buffer.from(text, "base64"));

export const text = (array) =>
  Buffer.from(array.buffer, array.byteOffset, array.byteLength).toString("base64");
