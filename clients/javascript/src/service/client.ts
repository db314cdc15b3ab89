/** The client that sends photos, and what it shares with the private one. */

import type { VeilfaceError } from "../errors.js";
import { sha256, type PackGraphs } from "../models/pack.js";
import type { FacePolicy } from "../models/selection.js";
import type { PublicContract } from "../templates/contract.js";
import type {
  Answer,
  Challenge,
  Decision,
  Enrollment,
  PackList,
  Receipt,
  Subject,
  SubjectPage,
  Token,
  TokenOutcome,
} from "./answers.js";
import { ConnectionFailed, errorOf, UnexpectedAnswer } from "./errors.js";
import { holderKeyField } from "./holder-keys.js";
import { DEFAULT_RETRIES, waitFor, type Resend, type Retries } from "./retries.js";

/** The most photos of one enrollment, and of one probe. */
export const ENROLL_PHOTOS = 10;
export const PROBE_PHOTOS = 5;

const SUBJECT = /^(?!\.{1,2}$)[A-Za-z0-9._@:-]{1,128}$/;
const TOKEN = /^vft_[A-Za-z0-9_-]{8,600}$/;
const VISIBLE = /^[\x21-\x7e]+$/;
const TEMPLATE_ID = /^[A-Za-z0-9_-]{1,64}$/;
// Connections that were never made, as Node names them; a browser does not tell.
const NEVER_MADE = new Set(["ECONNREFUSED", "ENOTFOUND", "EAI_AGAIN", "UND_ERR_CONNECT_TIMEOUT"]);

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

/** What an enrollment may replace: anything, nothing (false), or the template of this id only. */
export type Replace = boolean | string;

/** Options of every enrollment. */
export interface EnrollOptions {
  readonly face?: FacePolicy;
  /** 32 bytes of `newHolderKey()`, without which the enrollment accepts nobody. */
  readonly holderKey?: Uint8Array;
  readonly replace?: Replace;
}

/** Options of every verification. */
export interface VerifyOptions {
  readonly level?: string;
  readonly face?: FacePolicy;
  readonly holderKey?: Uint8Array;
}

/** One call: what is sent, made anew for each sending, and how its answer is read. */
export interface Call<T> {
  readonly method: "GET" | "POST" | "PUT" | "DELETE";
  readonly path: string;
  readonly headers?: Readonly<Record<string, string>>;
  readonly body?: () => FormData | object;
  /** Long answers tell of each piece that came, so that slow ones are not taken for lost. */
  readonly read: (response: Response, alive: () => void) => Promise<T>;
  readonly resend?: Resend;
}

/** The calls that carry no face: what `Client` and `PrivateClient` share. */
export class Session {
  readonly url: string;
  readonly #bearer: string;
  readonly #retries: Retries;
  readonly #timeout: number;
  readonly #fetch: typeof fetch;
  readonly #signal: AbortSignal | undefined;

  /**
   * @param url where the service is: `https://faces.example.org`.
   * @param bearer an API key, or in a page a token of one call.
   */
  constructor(url: string, bearer: string, options: ClientOptions = {}) {
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
    if (!VISIBLE.test(text(bearer, "the API key"))) {
      throw new RangeError("the API key has a character that no API key has, or is empty");
    }
    this.url = url.replace(/\/+$/, "");
    this.#bearer = bearer;
    this.#retries = { ...DEFAULT_RETRIES, ...options.retries };
    this.#timeout = options.timeout ?? 60;
    this.#signal = options.signal;
    this.#fetch = options.fetch ?? ((input, init) => fetch(input, init));
  }

  /** When an enrollment may be sent again: one that uses up a token or has a condition would meet itself. */
  protected resendOf(replace: Replace = true): Resend {
    return replace === true && !TOKEN.test(this.#bearer) ? "when-lost" : "when-not-done";
  }

  /** List one page of subjects. Right: `enroll`. */
  page({ limit = 100, cursor }: { limit?: number; cursor?: string } = {}): Promise<SubjectPage> {
    const query = new URLSearchParams({ limit: String(limit), ...(cursor && { cursor }) });
    const read = answer<SubjectPage>({ subjects: "array" });
    return this.send({ method: "GET", path: `/v1/subjects?${query}`, read });
  }

  /** Iterate over all subjects, in the order of their ids, a page at a time. */
  async *subjects(pageSize = 100): AsyncGenerator<Subject> {
    let cursor: string | undefined;
    do {
      const page = await this.page({ limit: pageSize, ...(cursor !== undefined && { cursor }) });
      yield* page.subjects;
      if (page.next_cursor !== null && page.next_cursor === cursor) {
        throw new UnexpectedAnswer("the page names itself as the next one");
      }
      cursor = page.next_cursor ?? undefined;
    } while (cursor !== undefined);
  }

  /** Describe a subject, without its template. Right: `enroll`. */
  describe(subject: string): Promise<Subject & Answer> {
    const read = answer<Subject & Answer>({ template_id: "string" });
    return this.send({ method: "GET", path: subjectPath(subject), read });
  }

  /** Erase a subject, for good; keep the receipt. Right: `erase`. */
  erase(subject: string): Promise<Receipt> {
    return this.send({
      method: "DELETE",
      path: subjectPath(subject),
      read: answer<Receipt>({ receipt: "object", claims: "object", log_purged: "boolean" }),
    });
  }

  /** Fetch the contract in force. */
  contract(): Promise<PublicContract & Answer> {
    const read = answer<PublicContract & Answer>({ contract_id: "string", binding: "object" });
    return this.send({ method: "GET", path: "/v1/contract", read });
  }

  /** Fetch the bytes of the decoy generator. Right: `embeddings`. */
  generator(): Promise<Uint8Array> {
    return this.send({ method: "GET", path: "/v1/contract/generator", read: readBytes });
  }

  /** Fetch the graphs of the contract, with a token, and check the SHA-256 of each. */
  async pack(): Promise<PackGraphs> {
    const list = await this.send({
      method: "GET",
      path: "/v1/pack",
      read: answer<PackList>({ files: "array" }),
    });
    const graphs: { -readonly [role in keyof PackGraphs]?: Uint8Array } = {};
    for (const file of list.files) {
      const path = `/v1/pack/${encodeURIComponent(file.sha256)}`;
      const bytes = await this.send({ method: "GET", path, read: readBytes });
      if ((await sha256(bytes)) !== file.sha256) {
        throw new UnexpectedAnswer(`the ${file.role} that came is not the one that was asked for`);
      }
      graphs[file.role] = bytes;
    }
    const { embedder, ...rest } = graphs;
    if (embedder === undefined) throw new UnexpectedAnswer("the pack has no embedder");
    return { embedder, ...rest };
  }

  /** Ask for a token that a page may hold. Right: that of the action. */
  token(
    subject: string,
    {
      action,
      level,
      lifetime,
      replace,
    }: {
      action: "verify" | "enroll";
      level?: string;
      /** Seconds. */
      lifetime?: number;
      /** Whether an enrollment may replace an earlier one. */
      replace?: boolean;
    },
  ): Promise<Token> {
    subjectPath(subject);
    return this.send({
      method: "POST",
      path: "/v1/tokens",
      body: () => fields({ subject_id: subject, action, level, lifetime_s: lifetime, replace }),
      read: answer<Token>({ token: "string", token_id: "string" }, ["token"]),
    });
  }

  /** Ask what came of a token: never believe the page. Right: that of the action. */
  tokenOutcome(subject: string, tokenId: string): Promise<TokenOutcome> {
    const path = subjectPath(subject, `/tokens/${encodeURIComponent(text(tokenId, "a token's id"))}`);
    return this.send({ method: "GET", path, read: answer<TokenOutcome>({ used: "boolean" }) });
  }

  /** Ask for a challenge of head movements, for one verification. Right: `verify`. */
  challenge(subject?: string): Promise<Challenge> {
    return this.send({
      method: "POST",
      path: "/v1/challenges",
      body: () => fields({ subject_id: subject }),
      read: answer<Challenge>({ challenge_id: "string", movements: "array" }),
    });
  }

  /** Ask once whether the service can answer; otherwise `Unavailable`. */
  ready(): Promise<Answer & { readonly status: string }> {
    const read = answer<Answer & { status: string }>({ status: "string" });
    return this.send({ method: "GET", path: "/health/ready", read, resend: "never" });
  }

  /** Send a call until it is answered, or the retries say that it is enough. */
  protected async send<T>(call: Call<T>): Promise<T> {
    for (let sending = 1; ; sending++) {
      this.#signal?.throwIfAborted();
      const outcome = await this.#sendOnce(call);
      if (!("failure" in outcome)) return outcome.value;
      const wait = waitFor(outcome.failure, {
        sending,
        resend: call.resend ?? "when-lost",
        retries: this.#retries,
      });
      if (wait === undefined) throw outcome.failure;
      await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
    }
  }

  async #sendOnce<T>(call: Call<T>): Promise<{ value: T } | { failure: VeilfaceError }> {
    const headers: Record<string, string> = {
      ...call.headers,
      Authorization: `Bearer ${this.#bearer}`,
      Accept: "application/json, */*",
    };
    const content = call.body?.();
    if (content !== undefined && !(content instanceof FormData)) {
      headers["Content-Type"] = "application/json";
    }
    const sending = new AbortController();
    const end = (): void => sending.abort();
    let late = false;
    let timer: ReturnType<typeof setTimeout> | undefined;
    const alive = (): void => {
      clearTimeout(timer);
      timer = setTimeout(() => {
        late = true;
        end();
      }, 1000 * this.#timeout);
    };
    this.#signal?.addEventListener("abort", end);
    alive();
    try {
      const response = await this.#fetch(this.url + call.path, {
        method: call.method,
        headers,
        redirect: "manual",
        credentials: "omit",
        signal: sending.signal,
        ...(content !== undefined && {
          body: content instanceof FormData ? content : JSON.stringify(content),
        }),
      });
      if (!response.ok) return { failure: await errorOf(response) };
      return { value: await call.read(response, alive) };
    } catch (error) {
      this.#signal?.throwIfAborted();
      if (error instanceof UnexpectedAnswer) return { failure: error };
      // Without its cause: its text may repeat a header.
      return { failure: connectionFailed(error, late) };
    } finally {
      clearTimeout(timer);
      this.#signal?.removeEventListener("abort", end);
    }
  }
}

/** Sends photos to the service, which embeds them. */
export class Client extends Session {
  /**
   * Enroll a subject by 1 to 10 photos of one person, or replace its enrollment. Right: `enroll`.
   *
   * @param options.attributes `gender` and `race`, for services that lift with hybrid+.
   */
  enroll(
    subject: string,
    photos: readonly Blob[],
    options: EnrollOptions & {
      readonly attributes?: Readonly<Record<string, string>>;
    } = {},
  ): Promise<Enrollment> {
    requirePhotos(photos, ENROLL_PHOTOS);
    const { attributes, face, holderKey, replace } = options;
    const more = {
      attributes: attributes && JSON.stringify(attributes),
      face,
      ...holderKeyField(holderKey),
    };
    return this.send({
      method: "PUT",
      path: subjectPath(subject, "/enrollment"),
      headers: precondition(replace),
      body: () => form("images", photos, more),
      read: readEnrollment,
      resend: this.resendOf(replace),
    });
  }

  /**
   * Check whether 1 to 5 photos of one person show the subject. Right: `verify`.
   *
   * A rejection is no error: ask the decision for `accepted`.
   *
   * @param options.challenge the photos are then the frames that answer it, in their order, as the
   *   camera gives them, not mirrored.
   */
  verify(
    subject: string,
    photos: readonly Blob[],
    options: VerifyOptions & { readonly challenge?: Challenge } = {},
  ): Promise<Decision> {
    // How many frames answer a challenge, the challenge says.
    requirePhotos(photos, options.challenge?.max_frames ?? PROBE_PHOTOS);
    const { level, face, holderKey, challenge } = options;
    const more = {
      level,
      face,
      challenge_id: challenge?.challenge_id,
      ...holderKeyField(holderKey),
    };
    return this.send({
      method: "POST",
      path: subjectPath(subject, "/verify"),
      body: () => form("image", photos, more),
      read: readDecision,
      resend: "when-not-done",
    });
  }
}

/** Refuse what JavaScript would turn into text: nobody is called "undefined". */
function text(value: unknown, what: string): string {
  if (typeof value === "string") return value;
  throw new TypeError(`${what} is a string, not ${value === null ? "null" : typeof value}`);
}

/** The path of a subject; a subject id needs no escapes in it. */
export function subjectPath(subject: string, rest = ""): string {
  if (!SUBJECT.test(text(subject, "a subject id"))) {
    throw new RangeError("a subject id has 1 to 128 characters out of A-Z a-z 0-9 . _ @ : -");
  }
  return `/v1/subjects/${subject}${rest}`;
}

/** The header that says what an enrollment may replace; none where it is anything. */
export function precondition(replace: Replace = true): Record<string, string> {
  if (replace === true) return {};
  if (replace === false) return { "If-None-Match": "*" };
  if (!TEMPLATE_ID.test(replace)) {
    throw new RangeError("replace is true, false, or the template_id of an enrollment");
  }
  return { "If-Match": `"${replace}"` };
}

/** Refuse photos that the service would refuse for their number. */
export function requirePhotos(photos: readonly unknown[], most: number): void {
  if (photos.length < 1 || photos.length > most) {
    throw new RangeError(`1 to ${most} photos are taken, not ${photos.length}`);
  }
}

/** The members that are there. */
export function fields(values: Readonly<Record<string, unknown>>): Record<string, unknown> {
  return Object.fromEntries(Object.entries(values).filter(([, value]) => value !== undefined));
}

function form(
  name: string,
  photos: readonly Blob[],
  more: Readonly<Record<string, string | undefined>>,
): FormData {
  const data = new FormData();
  // A file name of the user's machine is nobody else's business.
  for (const photo of photos) data.append(name, photo, "photo");
  for (const [field, value] of Object.entries(fields(more))) data.append(field, String(value));
  return data;
}

type Kind = "string" | "boolean" | "object" | "array";

const kindOf = (value: unknown): string =>
  value === null ? "null" : Array.isArray(value) ? "array" : typeof value;

/** Read JSON that must have these members; those of `concealed` are not printed with it. */
function answer<T extends object>(
  members: Readonly<Record<string, Kind>>,
  concealed: readonly string[] = [],
): (response: Response) => Promise<T> {
  return async (response) => {
    const text = await response.text();
    let body: unknown;
    try {
      body = JSON.parse(text);
    } catch {
      throw new UnexpectedAnswer("the answer is not JSON; is the URL that of the service?");
    }
    if (typeof body !== "object" || body === null) {
      throw new UnexpectedAnswer("the answer is no JSON object");
    }
    const found = body as Record<string, unknown>;
    const missing = Object.keys(members).filter((name) => kindOf(found[name]) !== members[name]);
    if (missing.length > 0) {
      throw new UnexpectedAnswer(`the answer lacks ${missing.join(", ")}`);
    }
    for (const name of concealed) {
      if (name in found) Object.defineProperty(found, name, { enumerable: false });
    }
    return found as T;
  };
}

export const readEnrollment = answer<Enrollment>({ template_id: "string", replaced: "boolean" });

/** A decision that is neither accept nor reject is none. */
export async function readDecision(response: Response): Promise<Decision> {
  const read = answer<Decision>({ decision: "string", level: "string" });
  const decision = await read(response);
  if (decision.decision !== "accept" && decision.decision !== "reject") {
    throw new UnexpectedAnswer("the answer is no decision");
  }
  return { ...decision, accepted: decision.decision === "accept" };
}

async function readBytes(response: Response, alive: () => void): Promise<Uint8Array> {
  const reader = response.body?.getReader();
  const pieces: Uint8Array[] = [];
  for (let piece = await reader?.read(); piece?.value !== undefined; piece = await reader?.read()) {
    alive();
    pieces.push(piece.value);
  }
  const bytes = new Uint8Array(pieces.reduce((sum, { length }) => sum + length, 0));
  let at = 0;
  for (const piece of pieces) {
    bytes.set(piece, at);
    at += piece.length;
  }
  return bytes;
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

