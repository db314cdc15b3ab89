/** The client that sends photos, and what it shares with the private one. */

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
} from "../answers.js";
import { base64url, concealed } from "../bytes.js";
import { ContractError, UnexpectedAnswer } from "../errors.js";
import type { FacePolicy } from "../models/faces.js";
import type { PackGraphs } from "../models/pack.js";
import type { PublicContract } from "../templates/contract.js";
import { requireText, Sender, type ClientOptions } from "./sending.js";

/** The most photos of one enrollment, and of one probe. */
export const ENROLL_PHOTOS = 10;
export const PROBE_PHOTOS = 5;

const SUBJECT = /^(?!\.{1,2}$)[\p{L}\p{M}\p{N}._@:-]{1,128}$/u;
const TEMPLATE_ID = /^[A-Za-z0-9_-]{1,64}$/;
const HOLDER_KEY_BYTES = 32;

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

/** Draw a holder key, 32 bytes: only the person keeps it, and nothing restores it. */
export const newHolderKey = (): Uint8Array =>
  crypto.getRandomValues(new Uint8Array(HOLDER_KEY_BYTES));

/** The calls that carry no face: what `Client` and `PrivateClient` share. */
export class Session {
  protected readonly sender: Sender;

  /**
   * @param url where the service is: `https://faces.example.org`.
   * @param bearer an API key, or in a page a token of one call.
   */
  constructor(url: string, bearer: string, options: ClientOptions = {}) {
    this.sender = new Sender(url, bearer, options);
  }

  get url(): string {
    return this.sender.url;
  }

  /** List one page of subjects. Right: `enroll`. */
  page({ limit = 100, cursor }: { limit?: number; cursor?: string } = {}): Promise<SubjectPage> {
    const query = new URLSearchParams({ limit: String(limit), ...(cursor && { cursor }) });
    return this.sender.json({ method: "GET", path: `/v1/subjects?${query}` });
  }

  /** Iterate over all subjects, in the order of their ids, a page at a time. */
  async *subjects(pageSize = 100): AsyncGenerator<Subject> {
    let cursor: string | undefined;
    do {
      const page = await this.page({ limit: pageSize, ...(cursor !== undefined && { cursor }) });
      yield* page.subjects;
      cursor = page.next_cursor ?? undefined;
    } while (cursor !== undefined);
  }

  /** Describe a subject, without its template. Right: `enroll`. */
  async describe(subject: string): Promise<Subject & Answer> {
    return this.sender.json({ method: "GET", path: subjectPath(subject) });
  }

  /** Erase a subject, for good; keep the receipt. Right: `erase`. */
  async erase(subject: string): Promise<Receipt> {
    return this.sender.json({ method: "DELETE", path: subjectPath(subject) });
  }

  /** Fetch the contract in force. */
  contract(): Promise<PublicContract> {
    return this.sender.json({ method: "GET", path: "/v1/contract" });
  }

  /** Fetch the bytes of the decoy generator. Right: `embeddings`. */
  generator(): Promise<Uint8Array> {
    return this.sender.bytes({ method: "GET", path: "/v1/contract/generator" });
  }

  /** Fetch the graphs of the contract, with a token; what loads them checks the SHA-256 of each. */
  async pack(): Promise<PackGraphs> {
    const { files } = await this.sender.json<PackList>({ method: "GET", path: "/v1/pack" });
    const graphs: Record<string, Uint8Array> = {};
    for (const { role, sha256 } of files) {
      const path = `/v1/pack/${encodeURIComponent(sha256)}`;
      graphs[role] = await this.sender.bytes({ method: "GET", path });
    }
    const { embedder, detector } = graphs;
    if (embedder === undefined) throw new ContractError("the pack has no embedder");
    return { embedder, ...(detector && { detector }) };
  }

  /**
   * Ask for a token that a page may hold. Right: that of the action.
   *
   * @param options.lifetime seconds.
   * @param options.replace whether an enrollment may replace an earlier one.
   */
  async token(
    subject: string,
    { lifetime, ...asked }: { action: "verify" | "enroll"; level?: string; lifetime?: number; replace?: boolean },
  ): Promise<Token> {
    subjectPath(subject);
    const body = given({ subject_id: subject, ...asked, lifetime_s: lifetime });
    const token = await this.sender.json<Token>({ method: "POST", path: "/v1/tokens", body });
    return concealed(token, "token");
  }

  /** Ask what came of a token: never believe the page. Right: that of the action. */
  async tokenOutcome(subject: string, tokenId: string): Promise<TokenOutcome> {
    const id = encodeURIComponent(requireText(tokenId, "a token's id"));
    return this.sender.json({ method: "GET", path: subjectPath(subject, `/tokens/${id}`) });
  }

  /** Ask for a challenge of head movements, for one verification. Right: `verify`. */
  challenge(subject?: string): Promise<Challenge> {
    const body = given({ subject_id: subject });
    return this.sender.json({ method: "POST", path: "/v1/challenges", body });
  }

  /** Ask whether the service can answer; otherwise a `ServiceError` of status 503. */
  ready(): Promise<Answer & { readonly status: string }> {
    return this.sender.json({ method: "GET", path: "/health/ready" });
  }

  /** Enroll by photos or by a template. */
  protected putEnrollment(
    subject: string,
    replace: Replace = true,
    body: FormData | object,
  ): Promise<Enrollment> {
    return this.sender.json({
      method: "PUT",
      path: subjectPath(subject, "/enrollment"),
      headers: precondition(replace),
      body,
      // Sent again, one that uses up a token or has a condition would meet itself.
      onlyOnce: replace !== true || this.sender.isToken,
    });
  }

  /** Verify photos or a template. */
  protected postProbe(subject: string, body: FormData | object): Promise<Decision> {
    return this.decide({ path: subjectPath(subject, "/verify"), body, onlyOnce: true });
  }

  /** Ask for a decision; an answer that is neither accept nor reject is none. */
  protected async decide(sent: {
    path: string;
    body: FormData | object;
    onlyOnce: boolean;
  }): Promise<Decision> {
    const answer = await this.sender.json<Decision>({ method: "POST", ...sent });
    if (answer.decision !== "accept" && answer.decision !== "reject") {
      throw new UnexpectedAnswer("the answer is no decision");
    }
    return { ...answer, accepted: answer.decision === "accept" };
  }
}

/** Sends photos to the service, which embeds them. */
export class Client extends Session {
  /**
   * Enroll a subject by 1 to 10 photos of one person, or replace its enrollment. Right: `enroll`.
   *
   * @param options.attributes `gender` and `race`, for services that lift with hybrid+.
   */
  async enroll(
    subject: string,
    photos: readonly Blob[],
    options: EnrollOptions & { readonly attributes?: Readonly<Record<string, string>> } = {},
  ): Promise<Enrollment> {
    requirePhotos(photos, ENROLL_PHOTOS);
    const { attributes, face, holderKey, replace } = options;
    const more = { attributes: attributes && JSON.stringify(attributes), face };
    return this.putEnrollment(subject, replace, form("images", photos, { ...more, ...keyField(holderKey) }));
  }

  /**
   * Check whether 1 to 5 photos of one person show the subject. Right: `verify`.
   *
   * A rejection is no error: ask the decision for `accepted`.
   *
   * @param options.challenge the photos are then the frames that answer it, in their order, as the
   *   camera gives them, not mirrored.
   */
  async verify(
    subject: string,
    photos: readonly Blob[],
    options: VerifyOptions & { readonly challenge?: Challenge } = {},
  ): Promise<Decision> {
    // How many frames answer a challenge, the challenge says.
    requirePhotos(photos, options.challenge?.max_frames ?? PROBE_PHOTOS);
    const { level, face, holderKey, challenge } = options;
    const more = { level, face, challenge_id: challenge?.challenge_id, ...keyField(holderKey) };
    return this.postProbe(subject, form("image", photos, more));
  }

  /**
   * Check whether two photos show one person; nothing is stored. Right: `verify`.
   *
   * The first stands for an enrollment, and the second is decided as by `verify`. No attempt is
   * counted on anybody, so a lost answer is asked for again.
   */
  async compare(
    first: Blob,
    second: Blob,
    options: { readonly level?: string; readonly face?: FacePolicy } = {},
  ): Promise<Decision> {
    const body = form("images", [first, second], { ...options });
    return this.decide({ path: "/v1/compare", body, onlyOnce: false });
  }
}

/** The path of a subject, whose id the service reads in NFC. */
export function subjectPath(subject: string, rest = ""): string {
  const id = requireText(subject, "a subject id").normalize("NFC");
  if (!SUBJECT.test(id)) {
    throw new RangeError("a subject id has 1 to 128 characters: letters, marks and digits, and . _ @ : -");
  }
  return `/v1/subjects/${encodeURIComponent(id)}${rest}`;
}

/** The header that says what an enrollment may replace. */
function precondition(replace: Replace): Record<string, string> {
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

/** The members that are not undefined. */
export const given = (values: Readonly<Record<string, unknown>>): Record<string, unknown> =>
  Object.fromEntries(Object.entries(values).filter(([, value]) => value !== undefined));

/** The field of a holder key; none where there is no key. The error does not repeat it. */
export function keyField(key: Uint8Array | undefined): { holder_key?: string } {
  if (key === undefined) return {};
  if (key.length !== HOLDER_KEY_BYTES) {
    throw new RangeError(`a holder key is ${HOLDER_KEY_BYTES} bytes: make one with newHolderKey()`);
  }
  return { holder_key: base64url(key) };
}

function form(
  name: string,
  photos: readonly Blob[],
  fields: Readonly<Record<string, string | undefined>>,
): FormData {
  const data = new FormData();
  // A file name of the user's machine is nobody else's business.
  for (const photo of photos) data.append(name, photo, "photo");
  for (const [field, value] of Object.entries(given(fields))) data.append(field, String(value));
  return data;
}
