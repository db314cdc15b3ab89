// Accounts with a password first and a face second; of the face, the page sends a private template.
// Node 20 or newer, the JavaScript client (make javascript), and what docs/login.md says of the
// service.
import { randomBytes, scrypt, timingSafeEqual } from "node:crypto";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { extname } from "node:path";
import { json } from "node:stream/consumers";
import { promisify } from "node:util";
// In a project of yours: "veilface-client"; its files, and those of the runtime, are in node_modules.
import { Client } from "../../clients/javascript/dist/index.js";

const { VEILFACE_URL, VEILFACE_API_KEY, PORT = "3000" } = process.env;
const service = VEILFACE_URL.replace(/\/+$/, "");
const veilface = new Client(service, VEILFACE_API_KEY);
// Of a connection, not of a path: a browser takes a path without a slash at its end for one file.
const policy =
  "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; " +
  `connect-src 'self' ${new URL(service).origin}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'`;
const accounts = new Map(); // name to account; yours live in a database
const sessions = new Map(); // id to { account, face, tokenId }: who knew the password

class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

const hash = (password, salt) =>
  promisify(scrypt)(password, salt, 64, { N: 2 ** 15, r: 8, p: 3, maxmem: 2 ** 26 });

function open(response, session) {
  const id = randomBytes(24).toString("base64url");
  sessions.set(id, session);
  response.setHeader("Set-Cookie", `session=${id}; HttpOnly; Secure; SameSite=Strict; Path=/`);
}

async function credentials(request) {
  // A form of another site can send this text too, but not with this type.
  if (!/^application\/json *(;|$)/i.test(request.headers["content-type"] ?? "")) throw new Refused(415, "not JSON");
  if (!(Number(request.headers["content-length"]) <= 1000)) throw new Refused(400, "too large");
  const { name, password } = (await json(request).catch(() => null)) ?? {};
  const texts = typeof name === "string" && typeof password === "string";
  if (!texts || !/^[\w.@-]{1,64}$/.test(name) || !/^.{8,256}$/s.test(password)) {
    throw new Refused(422, "a name, and a password of 8 to 256 characters");
  }
  return { name, password };
}

// What the page is to do next, and where: to enroll where there is no face yet, and else to verify.
async function next(subject) {
  try {
    await veilface.describe(subject);
    return { service, action: "verify" };
  } catch (error) {
    if (error.code === "not_enrolled") return { service, action: "enroll" };
    throw error;
  }
}

const routes = {
  async "POST /register"(request, response) {
    const { name, password } = await credentials(request);
    const salt = randomBytes(16);
    const account = { name, subject: randomBytes(16).toString("hex"), salt };
    account.password = await hash(password, salt);
    if (accounts.has(name)) throw new Refused(409, "this name is taken");
    accounts.set(name, account);
    open(response, { account });
    return [201, { service, action: "enroll" }];
  },
  // In a program of yours, limit the guesses too.
  async "POST /login"(request, response) {
    const { name, password } = await credentials(request);
    const account = accounts.get(name);
    const { salt, password: expected } = account ?? { salt: Buffer.alloc(16), password: Buffer.alloc(64) };
    const right = timingSafeEqual(await hash(password, salt), expected);
    if (!account || !right) throw new Refused(401, "wrong name or password");
    const asked = await next(account.subject);
    open(response, { account });
    return [200, asked];
  },
  async "POST /token"(request, response, session) {
    const { subject } = session.account;
    const asked = await next(subject);
    // The first face only: who holds an older token must not replace it.
    const more = asked.action === "enroll" ? { replace: false } : {};
    const { token, token_id } = await veilface.token(subject, { action: asked.action, ...more });
    session.tokenId = token_id; // it stays here: the page could name another one
    return [200, { ...asked, subject, token }];
  },
  // Ask the service what the page did with its token, and let in who is accepted.
  async "POST /face"(request, response, session) {
    const { tokenId } = session;
    const { subject, name } = session.account;
    const { outcome } = tokenId ? await veilface.tokenOutcome(subject, tokenId) : {};
    session.tokenId = undefined; // it counts once, and stays where the service did not answer
    if (!["accept", "created"].includes(outcome)) return [200, { accepted: false, ...(await next(subject)) }];
    open(response, { account: session.account, face: true });
    return [200, { accepted: true, name }];
  },
  async "GET /account"(request, response, session) {
    if (!session.face) throw new Refused(401, "show your face");
    return [200, { name: session.account.name }];
  },
};
const unsigned = new Set(["POST /register", "POST /login"]);
const types = { ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm" };
const folders = {
  "/client/": "../../clients/javascript/dist/",
  "/ort/": "../../clients/javascript/node_modules/onnxruntime-web/dist/",
};

// The page, and what it runs: the name of a file has no dot in front, so none leaves its folder.
function fileOf(path) {
  if (path === "/") return "index.html";
  if (path === "/page.js") return "page.js";
  const [, folder, file] = /^(\/\w+\/)((?:\w+\/)*\w[\w.-]*\.(?:m?js|wasm))$/.exec(path) ?? [];
  return folder in folders ? folders[folder] + file : null;
}

async function sendFile(name, response) {
  const body = await readFile(new URL(name, import.meta.url)).catch(() => null);
  if (body === null) throw new Refused(404, "there is no such file");
  const headers = { "Content-Type": types[extname(name)], "Content-Security-Policy": policy };
  response.writeHead(200, headers).end(body);
}

createServer(async (request, response) => {
  try {
    const name = request.method === "GET" && fileOf(request.url);
    if (name) return await sendFile(name, response);
    const call = `${request.method} ${request.url}`;
    if (!Object.hasOwn(routes, call)) throw new Refused(404, "there is no such page");
    const [, id] = /(?:^|; )session=([\w-]+)/.exec(request.headers.cookie ?? "") ?? [];
    const session = sessions.get(id);
    if (!session && !unsigned.has(call)) throw new Refused(401, "sign in");
    const [status, body] = await routes[call](request, response, session);
    response.writeHead(status, { "Content-Type": "application/json" });
    response.end(body && JSON.stringify(body));
  } catch (error) {
    // Nobody gets in while the service does not answer.
    const [status, detail] =
      error instanceof Refused ? [error.status, error.message] : [502, "your face cannot be checked now"];
    response.writeHead(status, { "Content-Type": "application/json" });
    response.end(JSON.stringify({ detail }));
  }
}).listen(Number(PORT), "127.0.0.1");
