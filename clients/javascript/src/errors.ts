import type { Enrollable, Probe } from "./service/lifts.js";

/** Base of every error of this package. */
export class VeilfaceError extends Error {
  override name = "VeilfaceError";

  /**
   * What a private client had lifted when it failed, and what to repeat the call with in the place
   * of the photos: the service may have it. Undefined where there is none, or where it does not
   * fit the service's contract.
   */
  lift: Enrollable | Probe | undefined = undefined;
}
