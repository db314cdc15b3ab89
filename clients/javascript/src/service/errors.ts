/**
 * What can go wrong between this client and the service, as the Python client names it.
 *
 * ```text
 * VeilfaceError
 * ├── ServiceError            the service answered with an error: .code, .status, .details …
 * │   ├── InvalidRequest      the request itself: malformed, unknown field, too large
 * │   ├── PhotoRefused        a better photo heals it: no face, several, too small, blurred …
 * │   ├── Unauthorized        the API key or token
 * │   ├── Forbidden           a right that the API key or the token lacks
 * │   ├── NotFound
 * │   │   └── NotEnrolled
 * │   ├── Conflict
 * │   │   ├── ContractMismatch
 * │   │   ├── EnrollmentConflict
 * │   ├── LockedOut           wait .retryAfter, and offer another factor
 * │   ├── RateLimited
 * │   └── ServerFailed        a defect of the service
 * │       └── Unavailable     no pack, no database, or too much to do
 * ├── ConnectionFailed        no answer: .sent says whether the request may have been done
 * └── UnexpectedAnswer        an answer that is not the service's
 * ```
 *
 * A code that this version does not know gives the class of its status. No error repeats the API
 * key, a photo, or a template.
 */

import { VeilfaceError } from "../errors.js";

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

/** The service answered with an error. */
export class ServiceError extends VeilfaceError {
  // Each class writes its name out: a minifier renames the class.
  override name = "ServiceError";
  readonly code: string;
  readonly status: number;
  readonly details: Readonly<Record<string, unknown>>;
  readonly requestId: string | undefined;
  readonly retryAfter: number | undefined;

  constructor(facts: ErrorFacts) {
    super(facts.message);
    this.code = facts.code;
    this.status = facts.status;
    this.details = facts.details ?? {};
    this.requestId = facts.requestId;
    this.retryAfter = facts.retryAfter;
  }
}

/** The request is wrong, and will be every time. */
export class InvalidRequest extends ServiceError {
  override name = "InvalidRequest";
}
/** A photo does not serve; `details.image` is its position in an enrollment. */
export class PhotoRefused extends ServiceError {
  override name = "PhotoRefused";
}
/** The API key or token is unknown, revoked or used. */
export class Unauthorized extends ServiceError {
  override name = "Unauthorized";
}
/** The API key or token lacks a right. */
export class Forbidden extends ServiceError {
  override name = "Forbidden";
}
/** There is nothing to return. */
export class NotFound extends ServiceError {
  override name = "NotFound";
}
/** Nobody is enrolled under this id. */
export class NotEnrolled extends NotFound {
  override name = "NotEnrolled";
}
/** What the request builds on is not so. */
export class Conflict extends ServiceError {
  override name = "Conflict";
}
/** A template of another contract. */
export class ContractMismatch extends Conflict {
  override name = "ContractMismatch";
}
/** The subject has another template than may be replaced; `details.template_id` is it. */
export class EnrollmentConflict extends Conflict {
  override name = "EnrollmentConflict";
}
/** Too many failed attempts on the subject; `details.disabled`: an operator must act. */
export class LockedOut extends ServiceError {
  override name = "LockedOut";
}
/** Too many requests with this API key or from this address. */
export class RateLimited extends ServiceError {
  override name = "RateLimited";
}
/** The service failed. */
export class ServerFailed extends ServiceError {
  override name = "ServerFailed";
}
/** The service cannot do it now. */
export class Unavailable extends ServerFailed {
  override name = "Unavailable";
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
    super(message);
  }
}

/** The answer is not what the service would say. */
export class UnexpectedAnswer extends VeilfaceError {
  override name = "UnexpectedAnswer";
}

type Family = new (facts: ErrorFacts) => ServiceError;

/** Every error code of the service, with its class. */
export const FAMILIES: Readonly<Record<string, Family>> = {
  malformed_request: InvalidRequest,
  unsupported_image: PhotoRefused,
  invalid_template: InvalidRequest,
  invalid_embedding: InvalidRequest,
  unauthorized: Unauthorized,
  replayed: Unauthorized,
  forbidden: Forbidden,
  not_enrolled: NotEnrolled,
  not_found: NotFound,
  method_not_allowed: InvalidRequest,
  contract_mismatch: ContractMismatch,
  enrollment_conflict: EnrollmentConflict,
  image_too_large: PhotoRefused,
  request_too_large: InvalidRequest,
  too_many_images: InvalidRequest,
  no_face: PhotoRefused,
  multiple_faces: PhotoRefused,
  face_too_small: PhotoRefused,
  low_quality: PhotoRefused,
  inconsistent_images: PhotoRefused,
  uncalibrated: InvalidRequest,
  validation_failed: InvalidRequest,
  locked_out: LockedOut,
  rate_limited: RateLimited,
  internal_error: ServerFailed,
  model_unavailable: Unavailable,
  store_unavailable: Unavailable,
  overloaded: Unavailable,
};

const BY_STATUS: Readonly<Record<number, Family>> = {
  401: Unauthorized,
  403: Forbidden,
  404: NotFound,
  409: Conflict,
  423: LockedOut,
  429: RateLimited,
  502: Unavailable,
  503: Unavailable,
  504: Unavailable,
};

const plain = (value: unknown): Record<string, unknown> =>
  typeof value === "object" && value !== null && !Array.isArray(value) ? { ...value } : {};

/** Give an answer that is no success its error. */
export async function errorOf(response: Response): Promise<VeilfaceError> {
  const { status } = response;
  if (status < 400) {
    return new UnexpectedAnswer(`the service never answers HTTP ${status}; is the URL right?`);
  }
  const fallback = BY_STATUS[status] ?? (status < 500 ? InvalidRequest : ServerFailed);
  const header = response.headers.get("Retry-After") ?? "";
  const retryAfter = /^[0-9]{1,9}$/.test(header) ? Number(header) : undefined;
  try {
    const body = (await response.json()) as {
      error: { code: unknown; message: unknown; details?: unknown };
      request_id?: unknown;
    };
    const { code, message } = body.error;
    const details = plain(body.error.details);
    if (typeof code === "string" && typeof message === "string") {
      const family = Object.hasOwn(FAMILIES, code) ? FAMILIES[code] : fallback;
      const requestId = typeof body.request_id === "string" ? body.request_id : undefined;
      return new family({ code, message, status, details, requestId, retryAfter });
    }
  } catch {
    // A proxy's page may repeat the request's headers: nothing of it is passed on.
  }
  return new fallback({
    code: `http_${status}`,
    message: `HTTP ${status}, without an error of the service`,
    status,
    retryAfter,
  });
}
