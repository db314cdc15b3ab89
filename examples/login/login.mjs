// Log people in by their face: POST /NAME with a form of up to five `images`. Node 18 or newer, no packages.
import { randomUUID } from "node:crypto";
import { createServer } from "node:http";
import { buffer } from "node:stream/consumers";

const { VEILFACE_URL, VEILFACE_API_KEY, PORT = "3000" } = process.env;
const sessions = new Map(); // session to name; yours live in a database

// The photos alone are sent on: a form must not choose how strictly it is judged.
async function photosOf(request) {
  const headers = { "Content-Type": request.headers["content-type"] ?? "" };
  const form = await new Response(await buffer(request), { headers }).formData();
  return form.getAll("images").filter((photo) => photo instanceof Blob);
}

async function login(name, photos) {
  const body = new FormData();
  for (const photo of photos) body.append("images", photo);
  const headers = { Authorization: `Bearer ${VEILFACE_API_KEY}` };
  const path = `${VEILFACE_URL}/v1/subjects/${encodeURIComponent(name)}/verify`;
  const signal = AbortSignal.timeout(30_000);
  const answer = await fetch(path, { method: "POST", body, headers, redirect: "error", signal });
  const { decision, error } = await answer.json();
  if ([401, 403].includes(answer.status)) throw new Error(error.message); // our key, not their face
  if (answer.status === 423) return [423, locked(error, Number(answer.headers.get("Retry-After")))];
  if (!answer.ok) return [answer.status, error.message]; // no face in the photo, too many requests …
  return decision === "accept" ? [204] : [401, "not recognised, try again"];
}

function locked({ details }, seconds) {
  const end = details.disabled ? "until an administrator lifts it" : `for ${seconds} s; an administrator can lift it`;
  return `too many attempts: locked ${end}`;
}

// The name in an address, or null. The service reads ids in NFC; no name may change the path of a call.
function nameIn(url) {
  try {
    const name = decodeURIComponent(url.slice(1)).normalize("NFC");
    return /^(?!\.{1,2}$)[\p{L}\p{M}\p{N}._@:-]{1,128}$/u.test(name) ? name : null;
  } catch {
    return null;
  }
}

createServer(async (request, response) => {
  const name = nameIn(request.url);
  const fits = name && Number(request.headers["content-length"]) <= 20_000_000;
  const photos = fits ? await photosOf(request).catch(() => []) : [];
  const [status, text] = photos.length
    ? await login(name, photos).catch(() => [502, "use your password"])
    : [400, "send a form with one to five `images`, of 20 MB together, to /NAME"];
  if (status === 204) {
    const session = randomUUID();
    sessions.set(session, name);
    response.setHeader("Set-Cookie", `session=${session}; HttpOnly; Secure; SameSite=Strict`);
  }
  response.writeHead(status).end(text);
}).listen(Number(PORT), "127.0.0.1");
