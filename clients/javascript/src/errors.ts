/**
 * What can go wrong. Every error has a `code`: the service's own, or one that is named here.
 *
 * ```text
 * VeilfaceError
 * ├── ServiceError         the service answered with an error: .status, .details, .requestId, .retryAfter
 * ├── ConnectionFailed     connection_failed: no answer; .sent says whether the request may have been done
 * ├── UnexpectedAnswer     unexpected_answer: an answer that is not the service's
 * ├── PhotoError           a photo that does not serve, found before anything was sent: .details, .image
 * ├── ContractError        unusable_contract: a contract, decoy generator or graph that cannot be used
 * └── PasskeyError         passkey_refused, passkey_unsupported, passkey_of_another: no key from a passkey
 * ```
 *
 * No error repeats an API key, a pixel, or a number of an embedding or of a template.
 */

import type { Lift } from "./service/private-client.js";

/** Base of every error of this package. */
export class VeilfaceError extends Error {
  // Each class writes its name out: a minifier renames the class.
  override name = "VeilfaceError";

  /**
   * What a private client had lifted when it failed, and what to repeat the call with in the place
   * of the photos: the service may have it. Undefined where nothing was lifted, or where the lift
   * does not fit the service's contract.
   */
  lift: Lift | undefined = undefined;

  constructor(
    readonly code: string,
    message: string,
  ) {
    super(message);
  }
}

/** What an answer with an error says. */
export interface ErrorFacts {
  /** One of the service's error codes; `http_<status>` where a proxy answered. */
  readonly code: string;
  /** For people; it may change. */
  readonly message: string;
  readonly status: number;
  readonly details?: Readonly<Record<string, unknown>>;
  /** Names the log line of the request. */
  readonly requestId?: string | undefined;
  /** Seconds to wait, where the service says so. */
  readonly retryAfter?: number | undefined;
}

/** The service answered with an error (docs/rest.md lists the codes). */
export class ServiceError extends VeilfaceError {
  override name = "ServiceError";
  readonly status: number;
  readonly details: Readonly<Record<string, unknown>>;
  readonly requestId: string | undefined;
  readonly retryAfter: number | undefined;

  constructor(facts: ErrorFacts) {
    super(facts.code, facts.message);
    this.status = facts.status;
    this.details = facts.details ?? {};
    this.requestId = facts.requestId;
    this.retryAfter = facts.retryAfter;
  }
}

/** No answer arrived. */
export class ConnectionFailed extends VeilfaceError {
  override name = "ConnectionFailed";

  /**
   * @param sent false if the connection was never made; true if the service may have done what was
   *   asked, which is all that a browser can say.
   */
  constructor(
    message: string,
    readonly sent: boolean,
  ) {
    super("connection_failed", message);
  }
}

/** The answer is not what the service would say. */
export class UnexpectedAnswer extends VeilfaceError {
  override name = "UnexpectedAnswer";

  constructor(message: string) {
    super("unexpected_answer", message);
  }
}

/** A photo does not serve, or several do not show one person; found where it was to be lifted. */
export class PhotoError extends VeilfaceError {
  override name = "PhotoError";

  /** Position from 0 of the photo that it is about, where several were lifted together. */
  image: number | undefined = undefined;

  /** @param details measured values and limits, or positions of photos, as the service has them. */
  constructor(
    code: string,
    message: string,
    readonly details: Readonly<Record<string, unknown>> = {},
  ) {
    super(code, message);
  }
}

/** A contract that is broken, or a decoy generator or a graph that is not its own or hides nothing. */
export class ContractError extends VeilfaceError {
  override name = "ContractError";

  constructor(message: string) {
    super("unusable_contract", message);
  }
}

/** There is no key from a passkey. */
export class PasskeyError extends VeilfaceError {
  override name = "PasskeyError";

  /**
   * @param code `passkey_refused` covers cancelled, too late and not there, which browsers do not
   *   tell apart; `passkey_unsupported`: no WebAuthn, or no PRF extension.
   */
  constructor(
    override readonly code: "passkey_refused" | "passkey_unsupported" | "passkey_of_another",
    message: string,
  ) {
    super(code, message);
  }
}

const PHOTO_CODES: ReadonlySet<string> = new Set([
  "unsupported_image",
  "image_too_large",
  "no_face",
  "multiple_faces",
  "face_too_small",
  "low_quality",
  "inconsistent_images",
]);

/** Whether another photo may help, be it the service that refused this one or the client. */
export const isPhotoRefused = (error: unknown): boolean =>
  error instanceof VeilfaceError && PHOTO_CODES.has(error.code);
