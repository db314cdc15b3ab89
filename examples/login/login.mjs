// Log people in by their face: POST /NAME with a photo as the body. Node 18 or newer, no packages.
import { randomUUID } from "node:crypto";
import { createServer } from "node:http";
import { buffer } from "node:stream/consumers";

const { VEILFACE_URL, VEILFACE_API_KEY, PORT = "3000" } = process.env;
const sessions = new Map(); // session to name; yours live in a database

async function login(name, photo) {
  const body = new FormData();
  body.append("image", new Blob([await buffer(photo)]));
  const headers = { Authorization: `Bearer ${VEILFACE_API_KEY}` };
  const path = `${VEILFACE_URL}/v1/subjects/${name}/verify`;
  const signal = AbortSignal.timeout(30_000);
  const answer = await fetch(path, { method: "POST", body, headers, redirect: "error", signal });
  const { decision, error } = await answer.json();
  if ([401, 403].includes(answer.status)) throw new Error(error.message); // our key, not their face
  if (!answer.ok) return [answer.status, error.message]; // no face in the photo, locked out …
  return decision === "accept" ? [204] : [401, "this is somebody else"];
}

createServer(async (request, response) => {
  const [, name] = /^\/([\w.@:-]{1,128})$/.exec(request.url) ?? [];
  const fits = name && Number(request.headers["content-length"]) <= 10_000_000;
  const [status, text] = fits
    ? await login(name, request).catch(() => [502, "use your password"])
    : [400, "send a photo of at most 10 MB to /NAME"];
  if (status === 204) {
    const session = randomUUID();
    sessions.set(session, name);
    response.setHeader("Set-Cookie", `session=${session}; HttpOnly; Secure; SameSite=Strict`);
  }
  response.writeHead(status).end(text);
}).listen(Number(PORT), "127.0.0.1");
