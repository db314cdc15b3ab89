/** One call of the service: sent, read, and sent again where that is safe. */

import { ConnectionFailed, ServiceError, UnexpectedAnswer, VeilfaceError } from "../errors.js";

const TOKEN = /^vft_[A-Za-z0-9_-]{8,600}$/;
const VISIBLE = /^[\x21-\x7e]+$/;
// Connections that were never made, as Node names them; a browser does not tell.
const NEVER_MADE = new Set(["ECONNREFUSED", "ENOTFOUND", "EAI_AGAIN", "UND_ERR_CONNECT_TIMEOUT"]);

/** How often a call is sent, and how patiently. */
export interface Retries {
  /** The most times that one call is sent; 1 never sends again. */
  readonly sendings: number;
  /** The longest wait, in seconds. A `Retry-After` above it is not waited for: the error is thrown at once. */
  readonly patience: number;
}

export const DEFAULT_RETRIES: Retries = { sendings: 4, patience: 30 };

/** How a client connects. */
export interface ClientOptions {
  readonly retries?: Partial<Retries>;
  /** Seconds without an answer, or of a graph without another byte, after which a sending ends. */
  readonly timeout?: number;
  /** Ends whatever the client does; calls are then rejected with its reason. */
  readonly signal?: AbortSignal;
  /** In the place of the platform's `fetch`. */
  readonly fetch?: typeof fetch;
}

/** One call. */
export interface Call {
  readonly method: "GET" | "POST" | "PUT" | "DELETE";
  readonly path: string;
  readonly headers?: Readonly<Record<string, string>>;
  readonly body?: FormData | object;
  /** Whether it may be sent again where its answer was lost; without it, it may. */
  readonly onlyOnce?: boolean;
}

/** Sends calls under one bearer, an API key or a token. */
export class Sender {
  readonly url: string;
  readonly #bearer: string;
  readonly #retries: Retries;
  readonly #timeout: number;
  readonly #fetch: typeof fetch;
  readonly signal: AbortSignal | undefined;

  constructor(url: string, bearer: string, options: ClientOptions) {
    const parsed = URL.canParse(url) ? new URL(url) : undefined;
    if (
      parsed === undefined ||
      !/^https?:$/.test(parsed.protocol) ||
      // Also one that is empty: paths are put behind the text.
      /[?#]/.test(url) ||
      parsed.username + parsed.password !== ""
    ) {
      throw new RangeError("the URL is that of the service: https://HOST[:PORT]");
    }
    // fetch would repeat a header that it cannot send in its error.
    if (!VISIBLE.test(requireText(bearer, "the API key"))) {
      throw new RangeError("the API key has a character that no API key has, or is empty");
    }
    this.url = url.replace(/\/+$/, "");
    this.#bearer = bearer;
    this.#retries = { ...DEFAULT_RETRIES, ...options.retries };
    this.#timeout = options.timeout ?? 60;
    this.#fetch = options.fetch ?? ((input, init) => fetch(input, init));
    this.signal = options.signal;
  }

  /** Whether the bearer is a token, which one call uses up. */
  get isToken(): boolean {
    return TOKEN.test(this.#bearer);
  }

  /** Send a call until it is answered, or the retries say that it is enough; return the body. */
  async bytes(call: Call): Promise<Uint8Array<ArrayBuffer>> {
    for (let sending = 1; ; sending++) {
      this.signal?.throwIfAborted();
      try {
        return await this.#sendOnce(call);
      } catch (error) {
        this.signal?.throwIfAborted();
        const wait = waitFor(error, { sending, call, retries: this.#retries });
        if (wait === undefined) throw error;
        await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
      }
    }
  }

  /** Send a call whose answer is JSON. Every answer of the service names its request. */
  async json<T>(call: Call): Promise<T> {
    const text = new TextDecoder().decode(await this.bytes(call));
    let answer: { request_id?: unknown } | null;
    try {
      answer = JSON.parse(text);
    } catch {
      throw new UnexpectedAnswer("the answer is not JSON; is the URL that of the service?");
    }
    if (typeof answer?.request_id !== "string") {
      throw new UnexpectedAnswer("the answer is not the service's; is the URL right?");
    }
    return answer as T;
  }

  async #sendOnce({ method, path, headers, body }: Call): Promise<Uint8Array<ArrayBuffer>> {
    const isForm = body instanceof FormData;
    const ended = new AbortController();
    const end = (): void => ended.abort();
    let late = false;
    let timer: ReturnType<typeof setTimeout> | undefined;
    const alive = (): void => {
      clearTimeout(timer);
      timer = setTimeout(() => {
        late = true;
        end();
      }, 1000 * this.#timeout);
    };
    this.signal?.addEventListener("abort", end);
    alive();
    try {
      const response = await this.#fetch(this.url + path, {
        method,
        headers: {
          ...headers,
          Authorization: `Bearer ${this.#bearer}`,
          Accept: "application/json, */*",
          ...(body !== undefined && !isForm && { "Content-Type": "application/json" }),
        },
        redirect: "manual",
        credentials: "omit",
        signal: ended.signal,
        ...(body !== undefined && { body: isForm ? body : JSON.stringify(body) }),
      });
      if (!response.ok) throw await errorOf(response);
      return await readAll(response, alive);
    } catch (error) {
      if (error instanceof VeilfaceError) throw error;
      // Without its cause: its text may repeat a header.
      throw connectionFailed(error, late);
    } finally {
      clearTimeout(timer);
      this.signal?.removeEventListener("abort", end);
    }
  }
}

/** Read a body in pieces; each shows that the answer is slow, not lost. */
async function readAll(response: Response, alive: () => void): Promise<Uint8Array<ArrayBuffer>> {
  const pieces: Uint8Array<ArrayBuffer>[] = [];
  const reader = response.body?.getReader();
  for (let piece = await reader?.read(); piece?.value !== undefined; piece = await reader?.read()) {
    alive();
    pieces.push(piece.value);
  }
  return new Uint8Array(await new Blob(pieces).arrayBuffer());
}

/** Seconds to wait before sending again; undefined where the error is to be thrown. */
export function waitFor(
  error: unknown,
  { sending, call, retries }: { sending: number; call: Pick<Call, "onlyOnce">; retries: Retries },
): number | undefined {
  if (sending >= retries.sendings || !mayHeal(error, call.onlyOnce ?? false)) return undefined;
  const asked = (error instanceof ServiceError ? error.retryAfter : undefined) ?? 0;
  if (asked > retries.patience) return undefined;
  // As long as the service says and, with or without it, a random time that doubles.
  return asked + Math.random() * Math.min(retries.patience, 0.125 * 2 ** sending);
}

function mayHeal(error: unknown, onlyOnce: boolean): boolean {
  if (error instanceof ConnectionFailed) return !onlyOnce || !error.sent;
  if (!(error instanceof ServiceError)) return false;
  // The service refused these before it did anything.
  if (error.code === "rate_limited" || error.code === "overloaded") return true;
  return !onlyOnce && [502, 503, 504].includes(error.status) && error.code !== "model_unavailable";
}

/** Give an answer that is no success its error. */
async function errorOf(response: Response): Promise<VeilfaceError> {
  const { status } = response;
  if (status < 400) {
    return new UnexpectedAnswer(`the service never answers HTTP ${status}; is the URL right?`);
  }
  const header = response.headers.get("Retry-After") ?? "";
  const retryAfter = /^[0-9]{1,9}$/.test(header) ? Number(header) : undefined;
  try {
    const { error, request_id } = JSON.parse(await response.text());
    const { code, message, details } = error;
    if (typeof code === "string" && typeof message === "string") {
      const requestId = typeof request_id === "string" ? request_id : undefined;
      return new ServiceError({ code, message, status, details: { ...details }, requestId, retryAfter });
    }
  } catch {
    // A proxy's page may repeat the request's headers: nothing of it is passed on.
  }
  const message = `HTTP ${status}, without an error of the service`;
  return new ServiceError({ code: `http_${status}`, message, status, retryAfter });
}

function connectionFailed(error: unknown, late: boolean): ConnectionFailed {
  const { cause } = error as { cause?: { code?: string } };
  if (cause?.code !== undefined && NEVER_MADE.has(cause.code)) {
    return new ConnectionFailed(`the service was not reached (${cause.code})`, false);
  }
  const why = late ? "it took too long" : "the connection failed";
  return new ConnectionFailed(
    `no answer arrived (${why}); the service may have done what was asked`,
    true,
  );
}

/** Refuse what JavaScript would turn into text: nobody is called "undefined". */
export function requireText(value: unknown, what: string): string {
  if (typeof value === "string") return value;
  throw new TypeError(`${what} is a string, not ${value === null ? "null" : typeof value}`);
}
