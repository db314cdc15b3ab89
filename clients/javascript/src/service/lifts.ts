/** What a client has lifted: templates that enroll, and probes; no photo, and no embedding. */

abstract class Lift {
  readonly #template: Uint8Array;

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
}

/** A lifted probe. Use it once for each attempt it is meant for. */
export class Probe extends Lift {
  readonly kind = "probe";
}

/** A template that enrolls, lifted and not yet (or perhaps) sent. */
export class Enrollable extends Lift {
  readonly kind = "enrollment";
}
