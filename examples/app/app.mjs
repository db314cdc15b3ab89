// Accounts with a password first and a face second; the page sends its photos to Veilface itself.
// Node 18 or newer, no packages; an API key with the rights enroll and verify, and the address of
// this program in the service's setting cors_origins.
import { randomBytes, scrypt, timingSafeEqual } from "node:crypto";
import { readFileSync } from "node:fs";
import { createServer } from "node:http";
import { json } from "node:stream/consumers";
import { promisify } from "node:util";

const { VEILFACE_URL, VEILFACE_API_KEY, PORT = "3000" } = process.env;
const service = VEILFACE_URL.replace(/\/+$/, "");
const policy =
  `default-src 'none'; script-src 'self'; connect-src 'self' ${service}; frame-ancestors 'none'`;
const accounts = new Map(); // name to account; yours live in a database
const sessions = new Map(); // id to { account, face, tokenId }: who knew the password
const file = (name) => readFileSync(new URL(name, import.meta.url));

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
  if (!(Number(request.headers["content-length"]) <= 1000)) throw new Refused(400, "too large");
  const { name, password } = (await json(request).catch(() => null)) ?? {};
  const texts = typeof name === "string" && typeof password === "string";
  if (!texts || !/^[\w.@-]{1,64}$/.test(name) || !/^.{8,256}$/s.test(password)) {
    throw new Refused(422, "a name, and a password of 8 to 256 characters");
  }
  return { name, password };
}

async function veilface(path, body) {
  const answer = await fetch(`${service}/v1${path}`, {
    method: body ? "POST" : "GET",
    body: body && JSON.stringify(body),
    headers: { Authorization: `Bearer ${VEILFACE_API_KEY}`, "Content-Type": "application/json" },
  });
  const told = await answer.json();
  if (told.error?.code === "not_enrolled") return null;
  if (!answer.ok) throw new Error(told.error.message);
  return told;
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
    return [201];
  },
  // In a program of yours, limit the guesses too.
  async "POST /login"(request, response) {
    const { name, password } = await credentials(request);
    const account = accounts.get(name);
    const { salt, password: expected } = account ?? { salt: Buffer.alloc(16), password: Buffer.alloc(64) };
    const right = timingSafeEqual(await hash(password, salt), expected);
    if (!account || !right) throw new Refused(401, "wrong name or password");
    open(response, { account });
    return [204];
  },
  // To enroll where there is no face yet, and else to verify.
  async "POST /token"(request, response, session) {
    const { subject } = session.account;
    const enrolled = await veilface(`/subjects/${subject}`);
    const action = enrolled ? "verify" : "enroll";
    // The first face only: who holds an older token must not replace it.
    const first = enrolled ? {} : { replace: false };
    const { token, token_id } = await veilface("/tokens", { subject_id: subject, action, ...first });
    session.tokenId = token_id; // it stays here: the page could name another one
    const [method, path] = enrolled ? ["POST", "verify"] : ["PUT", "enrollment"];
    return [200, { action, method, url: `${service}/v1/subjects/${subject}/${path}`, token }];
  },
  // Ask the service what the page did with its token, and let in who is accepted.
  async "POST /face"(request, response, session) {
    const { tokenId } = session;
    session.tokenId = undefined;
    if (!tokenId) throw new Refused(409, "ask for a token first");
    const { outcome } = await veilface(`/subjects/${session.account.subject}/tokens/${tokenId}`);
    const accepted = ["accept", "created"].includes(outcome);
    if (accepted) open(response, { account: session.account, face: true });
    return [200, { accepted }];
  },
  async "GET /account"(request, response, session) {
    if (!session.face) throw new Refused(401, "show your face");
    return [200, { name: session.account.name }];
  },
};
const unsigned = new Set(["POST /register", "POST /login"]);
const files = {
  "/": [file("index.html"), { "Content-Type": "text/html", "Content-Security-Policy": policy }],
  "/page.js": [file("page.js"), { "Content-Type": "text/javascript" }],
};

createServer(async (request, response) => {
  try {
    if (request.method === "GET" && Object.hasOwn(files, request.url)) {
      const [body, headers] = files[request.url];
      return response.writeHead(200, headers).end(body);
    }
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
