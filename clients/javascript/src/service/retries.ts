/** When and how often a call is sent again, as the Python client does it. */

import type { VeilfaceError } from "../errors.js";
import { ConnectionFailed, RateLimited, ServiceError, Unavailable } from "./errors.js";

/** When a call may be sent again: also when its answer was lost, or only when it was not done. */
export type Resend = "when-lost" | "when-not-done" | "never";

/** How often, and how patiently; times in seconds. */
export interface Retries {
  /** The most times that one call is sent; 1 never sends again. */
  readonly sendings: number;
  /** Without `Retry-After` the wait is uniform in 0 to `first`, doubled with each sending … */
  readonly first: number;
  /** … up to this. */
  readonly longest: number;
  /** A `Retry-After` above this is not waited for: the error is thrown at once. */
  readonly patience: number;
}

export const DEFAULT_RETRIES: Retries = { sendings: 4, first: 0.25, longest: 8, patience: 30 };

/** Seconds to wait before sending again; undefined: throw the error. */
export function waitFor(
  error: VeilfaceError,
  { sending, resend, retries }: { sending: number; resend: Resend; retries: Retries },
): number | undefined {
  if (resend === "never" || sending >= retries.sendings) return undefined;
  if (!heals(error, resend)) return undefined;
  const told = (error instanceof ServiceError ? error.retryAfter : undefined) ?? 0;
  if (told > retries.patience) return undefined;
  const spread = Math.min(retries.longest, retries.first * 2 ** (sending - 1));
  return told + Math.random() * spread;
}

function heals(error: VeilfaceError, resend: Resend): boolean {
  const lostIsSafe = resend === "when-lost";
  if (error instanceof ConnectionFailed) return lostIsSafe || !error.sent;
  if (error instanceof RateLimited) return true;
  if (error instanceof Unavailable) {
    return error.code === "overloaded" || (lostIsSafe && error.code !== "model_unavailable");
  }
  return false;
}
