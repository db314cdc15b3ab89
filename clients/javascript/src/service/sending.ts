/** One call of the service: sent, read, and sent again where the service was too busy for it. */

import { VeilfaceError } from "../errors.js";

const BUSY = new Set(["overloaded", "rate_limited"]);
const SENDINGS = 4;
const VISIBLE = /^[\x21-\x7e]+$/;
// Connections that were never made, as Node names them; a browser does not tell.
const NEVER_MADE = new Set(["ECONNREFUSED", "ENOTFOUND", "EAI_AGAIN", "UND_ERR_CONNECT_TIMEOUT"]);

/** How a client connects. */
export interface ClientOptions {
  /** The longest wait before a call is sent again, in seconds; 0 sends each once. */
  readonly patience?: number;
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
  /** A token in the place of the client's bearer. */
  readonly token?: string | undefined;
}

/** Sends calls under one bearer, an API key or a token. */
export class Sender {
  readonly url: string;
  readonly #bearer: string;
  readonly #patience: number;
  readonly #timeout: number;
  readonly #fetch: typeof fetch;
  protected readonly signal: AbortSignal | undefined;

  /**
   * @param url where the service is: `https://faces.example.org`.
   * @param bearer an API key, or in a page a token of one call.
   */
  constructor(url: string, bearer: string, options: ClientOptions = {}) {
    // Without a query, a fragment or a password: paths are put behind the text.
    if (!/^https?:[^?#@]+$/.test(url) || !URL.canParse(url)) {
      throw new RangeError("the URL is that of the service: https://HOST[:PORT]");
    }
    // fetch would repeat a header that it cannot send in its error.
    if (typeof bearer !== "string" || !VISIBLE.test(bearer)) {
      throw new RangeError("the API key has a character that no API key has, or is empty");
    }
    this.url = url.replace(/\/+$/, "");
    this.#bearer = bearer;
    this.#patience = options.patience ?? 30;
    this.#timeout = options.timeout ?? 60;
    this.#fetch = options.fetch ?? ((input, init) => fetch(input, init));
    this.signal = options.signal;
  }

  /** Send a call, again where the service refused it for its load before it did anything; return the body. */
  protected async bytes(call: Call): Promise<Uint8Array<ArrayBuffer>> {
    for (let sending = 1; ; sending++) {
      this.signal?.throwIfAborted();
      try {
        return await this.#sendOnce(call);
      } catch (error) {
        this.signal?.throwIfAborted();
        if (!(error instanceof VeilfaceError) || !BUSY.has(error.code) || sending === SENDINGS) throw error;
        // As long as the service says and, with or without it, a random time that doubles.
        const wait = (error.retryAfter ?? 0) + Math.random() * 0.125 * 2 ** sending;
        if (wait > this.#patience) throw error;
        await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
      }
    }
  }

  /** Send a call whose answer is JSON. Every answer of the service names its request. */
  protected async json<T>(call: Call): Promise<T> {
    const text = new TextDecoder().decode(await this.bytes(call));
    let answer: { request_id?: unknown } | null;
    try {
      answer = JSON.parse(text);
    } catch {
      throw new VeilfaceError("unexpected_answer", "the answer is not JSON; is the URL that of the service?");
    }
    if (typeof answer?.request_id !== "string") {
      throw new VeilfaceError("unexpected_answer", "the answer is not the service's; is the URL right?");
    }
    return answer as T;
  }

  async #sendOnce({ method, path, headers, body, token }: Call): Promise<Uint8Array<ArrayBuffer>> {
    const isForm = body instanceof FormData;
    const late = new AbortController();
    let timer: ReturnType<typeof setTimeout> | undefined;
    const alive = (): void => {
      clearTimeout(timer);
      timer = setTimeout(() => late.abort(), 1000 * this.#timeout);
    };
    alive();
    try {
      const response = await this.#fetch(this.url + path, {
        method,
        headers: {
          ...headers,
          Authorization: `Bearer ${token ?? this.#bearer}`,
          Accept: "application/json, */*",
          ...(body !== undefined && !isForm && { "Content-Type": "application/json" }),
        },
        redirect: "manual",
        credentials: "omit",
        signal: AbortSignal.any(this.signal ? [late.signal, this.signal] : [late.signal]),
        ...(body !== undefined && { body: isForm ? body : JSON.stringify(body) }),
      });
      if (!response.ok) throw await errorOf(response);
      return await readAll(response, alive);
    } catch (error) {
      if (error instanceof VeilfaceError) throw error;
      // Without its cause: its text may repeat a header.
      throw connectionFailed(error, late.signal.aborted);
    } finally {
      clearTimeout(timer);
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

/** Give an answer that is no success its error. */
async function errorOf(response: Response): Promise<VeilfaceError> {
  const { status } = response;
  if (status < 400) {
    return new VeilfaceError("unexpected_answer", `the service never answers HTTP ${status}; is the URL right?`);
  }
  const header = response.headers.get("Retry-After") ?? "";
  const retryAfter = /^[0-9]{1,9}$/.test(header) ? Number(header) : undefined;
  try {
    const { error, request_id } = JSON.parse(await response.text());
    const { code, message, details } = error;
    if (typeof code === "string" && typeof message === "string") {
      const requestId = typeof request_id === "string" ? request_id : undefined;
      return new VeilfaceError(code, message, { status, details: { ...details }, requestId, retryAfter });
    }
  } catch {
    // A proxy's page may repeat the request's headers: nothing of it is passed on.
  }
  const message = `HTTP ${status}, without an error of the service`;
  return new VeilfaceError(`http_${status}`, message, { status, retryAfter });
}

function connectionFailed(error: unknown, late: boolean): VeilfaceError {
  const { cause } = error as { cause?: { code?: string } };
  if (cause?.code !== undefined && NEVER_MADE.has(cause.code)) {
    return new VeilfaceError("connection_failed", `the service was not reached (${cause.code})`, { sent: false });
  }
  const why = late ? "it took too long" : "the connection failed";
  const message = `no answer arrived (${why}); the service may have done what was asked`;
  return new VeilfaceError("connection_failed", message, { sent: true });
}
