// Calls to the service, all to the page's own origin. The key is in memory, and unless the visitor
// unticks it in this tab's session storage, which a browser may restore with the tab from its disk.

const KEPT = "veilface-key";
// Where the service is, which may be below a prefix of a proxy's: paths of calls are put behind it.
export const BASE = new URL("..", import.meta.url).href.slice(0, -1);
let key = kept((storage) => storage.getItem(KEPT)) ?? null;
// Ends what still runs for a key that is forgotten.
let running = new AbortController();

const { dataset } = document.documentElement;
// Whether the service serves its pack, so that this page may lift.
export const LIFTS = dataset.private === "yes";
// `client` is the JavaScript client where it was built, `mode` the module of private mode where it is there.
export const session = { own: null, contract: null, client: null, mode: null, onrefused: () => {} };

export const hasKey = () => key !== null;

export function useKey(token, keep) {
  // A header carries visible ASCII only; anything else is no key.
  if (!/^[!-~]+$/.test(token)) {
    throw new Problem({ code: "unauthorized", message: "that is not an API key: keys begin with vf_" });
  }
  key = token;
  kept((storage) => (keep ? storage.setItem(KEPT, token) : storage.removeItem(KEPT)));
}

export function forgetKey() {
  key = null;
  session.own = session.contract = null;
  kept((storage) => storage.removeItem(KEPT));
  running.abort();
  running = new AbortController();
  session.mode?.forget();
}

// Some browsers are set to block the storage: then the key is not kept, and all else works.
function kept(use) {
  try {
    return use(sessionStorage);
  } catch {
    return null;
  }
}

export const may = (right) => session.own?.rights.includes(right) ?? false;

// An answer that is no success, or no answer at all (code "unreachable").
export class Problem extends Error {
  constructor(fields) {
    super(fields.message);
    Object.assign(this, { details: {}, requestId: null, retryAfter: null, status: 0 }, fields);
  }
}

// `json` is sent as a JSON body, in the place of `body`.
export async function call(method, path, { json, body, headers, signal } = {}) {
  if (json) [body, headers] = [JSON.stringify(json), { "Content-Type": "application/json", ...headers }];
  const used = key;
  const ended = AbortSignal.any([running.signal, ...(signal ? [signal] : [])]);
  let answer;
  try {
    answer = await fetch(BASE + path, {
      method,
      body,
      signal: ended,
      headers: { ...(used ? { Authorization: `Bearer ${used}` } : {}), ...headers },
      cache: "no-store",
      credentials: "omit",
    });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem({ code: "unreachable", message: "the service does not respond" });
  }
  if (answer.headers.get("X-Veilface-Notice")) dataset.demo = "yes";
  const content = await answer.json().catch(() => null);
  ended.throwIfAborted();
  if (answer.ok && content) return content;
  const problem = new Problem({
    status: answer.status,
    code: content?.error?.code ?? "unreachable",
    message: content?.error?.message ?? `status ${answer.status}, and not from this service`,
    details: content?.error?.details ?? {},
    requestId: content?.request_id ?? answer.headers.get("X-Request-ID"),
    retryAfter: Number(answer.headers.get("Retry-After")) || null,
  });
  // `replayed` is about a challenge; else the key itself was refused, if it is still in use.
  if (problem.code === "unauthorized" && session.own && used === key) session.onrefused(problem);
  throw problem;
}

export const subjectPath = (id) => `/v1/subjects/${encodeURIComponent(id)}`;

export function form(name, photos, fields = {}) {
  const data = new FormData();
  photos.forEach((blob, index) => data.append(name, blob, `${index}`));
  for (const [field, value] of Object.entries(fields)) if (value) data.append(field, value);
  return data;
}

export async function learn() {
  if (dataset.client === "yes") session.client ??= await import("./client/client.js").catch(() => null);
  if (LIFTS) session.mode ??= await import("./private.js").catch(() => null);
  [session.own, session.contract] = await Promise.all([call("GET", "/v1/key"), call("GET", "/v1/contract")]);
}

// Levels that a photo can be verified at with this key.
export const levels = () =>
  session.contract.calibrations
    .filter((each) => each.mode === "p2s" && each.probe_photos === 1)
    .flatMap((each) => each.levels)
    .filter((each) => session.own.levels.includes(each.name));

// Whether a verification must answer a challenge of head movements.
export const moves = () => ["active", "both"].includes(session.own?.liveness);
