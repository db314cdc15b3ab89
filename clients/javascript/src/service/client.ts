/** The client that sends photos, and what it shares with the private one. */

import type { Answer, Challenge, Decision, Enrollment, PackList, Receipt } from "../answers.js";
import type { Subject, SubjectPage, Token, TokenOutcome } from "../answers.js";
import { base64url, concealed } from "../bytes.js";
import { unusable, VeilfaceError } from "../errors.js";
import type { FacePolicy } from "../models/faces.js";
import type { PackGraphs } from "../models/pack.js";
import type { PublicContract } from "../templates/contract.js";
import { Sender } from "./sending.js";

// Anything else would be another path.
const SEGMENT = /^(?!\.{1,2}$)[^/]+$/;
const HOLDER_KEY_BYTES = 32;

/** Options of every enrollment. */
export interface EnrollOptions {
  readonly face?: FacePolicy;
  /** 32 bytes of `newHolderKey()`, without which the enrollment accepts nobody. */
  readonly holderKey?: Uint8Array;
  /** What may be replaced: anything, nothing (false), or the template of this id only. */
  readonly replace?: boolean | string;
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
export class Session extends Sender {
  /** Iterate over all subjects, in the order of their ids, a page at a time. Right: `enroll`. */
  async *subjects(pageSize = 100): AsyncGenerator<Subject> {
    const query = new URLSearchParams({ limit: String(pageSize) });
    for (let isMore = true; isMore; ) {
      const page: SubjectPage = await this.json({ method: "GET", path: `/v1/subjects?${query}` });
      yield* page.subjects;
      isMore = page.next_cursor !== null;
      query.set("cursor", String(page.next_cursor));
    }
  }

  /** Describe a subject, without its template. Right: `enroll`. */
  async describe(subject: string): Promise<Subject & Answer> {
    return this.json({ method: "GET", path: subjectPath(subject) });
  }

  /** Erase a subject, for good; keep the receipt. Right: `erase`. */
  async erase(subject: string): Promise<Receipt> {
    return this.json({ method: "DELETE", path: subjectPath(subject) });
  }

  /** Fetch the contract in force. */
  contract(): Promise<PublicContract> {
    return this.json({ method: "GET", path: "/v1/contract" });
  }

  /** Fetch the bytes of the decoy generator. Right: `embeddings`. */
  generator(): Promise<Uint8Array> {
    return this.bytes({ method: "GET", path: "/v1/contract/generator" });
  }

  /** Fetch the graphs of the contract, with a token; what loads them checks the SHA-256 of each. */
  async pack(): Promise<PackGraphs> {
    const { files } = await this.json<PackList>({ method: "GET", path: "/v1/pack" });
    const graphs: Record<string, Uint8Array> = {};
    for (const { role, sha256 } of files) {
      const path = `/v1/pack/${encodeURIComponent(sha256)}`;
      graphs[role] = await this.bytes({ method: "GET", path });
    }
    const { embedder, detector } = graphs;
    if (embedder === undefined) throw unusable("the pack has no embedder");
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
    const token = await this.json<Token>({ method: "POST", path: "/v1/tokens", body });
    return concealed(token, "token");
  }

  /** Ask what came of a token: never believe the page. Right: that of the action. */
  async tokenOutcome(subject: string, tokenId: string): Promise<TokenOutcome> {
    const path = subjectPath(subject, `/tokens/${encodeURIComponent(tokenId)}`);
    return this.json({ method: "GET", path });
  }

  /** Ask for a challenge of head movements, for one verification. Right: `verify`. */
  challenge(subject?: string): Promise<Challenge> {
    const body = given({ subject_id: subject });
    return this.json({ method: "POST", path: "/v1/challenges", body });
  }

  /** Enroll by photos or by a template. */
  protected putEnrollment(
    subject: string,
    replace: boolean | string = true,
    body: FormData | object,
    token?: string,
  ): Promise<Enrollment> {
    return this.json({
      method: "PUT",
      path: subjectPath(subject, "/enrollment"),
      headers: precondition(replace),
      body,
      token,
    });
  }

  /** Verify photos or a template; an answer that is neither accept nor reject is none. */
  protected async postProbe(subject: string, body: FormData | object, token?: string): Promise<Decision> {
    const path = subjectPath(subject, "/verify");
    const answer = await this.json<Decision>({ method: "POST", path, body, token });
    if (answer.decision !== "accept" && answer.decision !== "reject") {
      throw new VeilfaceError("unexpected_answer", "the answer is no decision");
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
    const { attributes, face, holderKey, replace } = options;
    const fields = { attributes: attributes && JSON.stringify(attributes), face, ...keyField(holderKey) };
    return this.putEnrollment(subject, replace, form("images", photos, fields));
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
    const { level, face, holderKey, challenge } = options;
    const more = { level, face, challenge_id: challenge?.challenge_id, ...keyField(holderKey) };
    return this.postProbe(subject, form("image", photos, more));
  }
}

/** The path of a subject. */
export function subjectPath(subject: string, rest = ""): string {
  // What is no text would become some: nobody is called "undefined".
  if (typeof subject !== "string" || !SEGMENT.test(subject)) {
    throw new RangeError("a subject id is letters, marks and digits, and . _ @ : -");
  }
  return `/v1/subjects/${encodeURIComponent(subject)}${rest}`;
}

/** The header that says what an enrollment may replace. */
function precondition(replace: boolean | string): Record<string, string> {
  if (replace === true) return {};
  return replace === false ? { "If-None-Match": "*" } : { "If-Match": `"${replace}"` };
}

/** The members that are not undefined. */
export const given = (values: Readonly<Record<string, unknown>>): Record<string, unknown> =>
  Object.fromEntries(Object.entries(values).filter(([, value]) => value !== undefined));

/** The field of a holder key. */
export const keyField = (key: Uint8Array | undefined): { holder_key: string | undefined } => ({
  holder_key: key && base64url(key),
});

function form(name: string, photos: readonly Blob[], fields: Readonly<Record<string, string | undefined>>): FormData {
  const data = new FormData();
  // A file name of the user's machine is nobody else's business.
  for (const photo of photos) data.append(name, photo, "photo");
  for (const [field, value] of Object.entries(given(fields))) data.append(field, String(value));
  return data;
}
