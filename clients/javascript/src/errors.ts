/**
 * What can go wrong: one class, whose `code` says what.
 *
 * - a code of the service (docs/rest.md): it answered with an error, and `status` is there; or, without a `status`, a
 *   photo does not serve, which was found before anything was sent;
 * - `http_<status>`: a proxy answered in the place of the service;
 * - `connection_failed`: no answer arrived; `sent` says whether the request may have been done;
 * - `unexpected_answer`: an answer that is not the service's;
 * - `unusable_contract`: a contract that is broken, or a decoy generator or a graph that is not its own or hides nothing;
 * - `passkey_refused` (cancelled, too late and not there, which browsers do not tell apart), `passkey_unsupported` (no
 *   WebAuthn, or no PRF extension), `passkey_of_another`: there is no key from a passkey.
 *
 * No error repeats an API key, a pixel, or a number of an embedding or of a template.
 */

import type { Lift } from "./service/private-client.js";

/** What an error has beside its code and its message. */
export interface ErrorFacts {
  readonly status?: number;
  /** Measured values and limits, positions of photos, and what else the service names. */
  readonly details?: Readonly<Record<string, unknown>>;
  /** Names the log line of the request. */
  readonly requestId?: string | undefined;
  /** Seconds to wait, where the service says so. */
  readonly retryAfter?: number | undefined;
  /** False if the connection was never made; true if the service may have done what was asked. */
  readonly sent?: boolean;
}

/** Every error of this package. */
export class VeilfaceError extends Error {
  // Written out: a minifier renames the class.
  override name = "VeilfaceError";
  readonly status: number | undefined;
  readonly details: Readonly<Record<string, unknown>>;
  readonly requestId: string | undefined;
  readonly retryAfter: number | undefined;
  readonly sent: boolean | undefined;
  /** Position from 0 of the photo that it is about, where several were lifted together. */
  image: number | undefined = undefined;
  /**
   * What a private client had lifted when it failed, and what to repeat the call with in the place
   * of the photos: the service may have it. Undefined where nothing was lifted, or where the lift
   * does not fit the service's contract.
   */
  lift: Lift | undefined = undefined;

  /** @param message for people; it may change. */
  constructor(
    readonly code: string,
    message: string,
    facts: ErrorFacts = {},
  ) {
    super(message);
    this.status = facts.status;
    this.details = facts.details ?? {};
    this.requestId = facts.requestId;
    this.retryAfter = facts.retryAfter;
    this.sent = facts.sent;
  }
}

/** Make the error of a contract, decoy generator or graph that cannot be used. */
export const unusable = (message: string): VeilfaceError => new VeilfaceError("unusable_contract", message);

const PHOTO_CODES: ReadonlySet<string> = new Set([
  "unsupported_image", "image_too_large", "no_face", "multiple_faces", "face_too_small", "low_quality",
  "inconsistent_images",
]);

/** Whether another photo may help, be it the service that refused this one or the client. */
export const isPhotoRefused = (error: unknown): error is VeilfaceError =>
  error instanceof VeilfaceError && PHOTO_CODES.has(error.code);
