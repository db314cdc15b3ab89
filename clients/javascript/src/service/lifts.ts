/** What a client has lifted: templates that enroll, and probes; no photo, and no embedding. */

import { sha256 } from "../models/pack.js";
import { randomText } from "./base64.js";

abstract class Lift {
  readonly #template: Uint8Array;
  readonly #key = randomText(24);
  /** Seconds since 1970. */
  readonly liftedAt = Math.floor(Date.now() / 1000);

  constructor(
    template: Uint8Array,
    readonly contractId: string,
  ) {
    this.#template = template;
  }

  /** The wire bytes. Printing the lift does not show them. */
  get template(): Uint8Array {
    return this.#template;
  }

  /** The `Idempotency-Key` of a subject: another subject is another write. */
  keyFor(subject: string): Promise<string> {
    return sha256(new TextEncoder().encode(`${this.#key}/${subject}`));
  }
}

/** A lifted probe. Use it once for each attempt it is meant for. */
export class Probe extends Lift {
  readonly kind = "probe";
}

/** A template that enrolls, lifted and not yet (or perhaps) sent. */
export class Enrollable extends Lift {
  readonly kind = "enrollment";
}
