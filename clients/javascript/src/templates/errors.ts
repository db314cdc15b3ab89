/**
 * What can go wrong between embeddings and a private template.
 *
 * ```text
 * TemplateError
 * ├── ContractError            a contract that is broken, or a pack or generator of another one
 * ├── DecoyError               a decoy generator that is broken, or would hide nothing
 * ├── LiftingError             a lift that cannot be made
 * └── InconsistentImages       .apart, .others: photos that do not show one and the same person
 * ```
 *
 * Messages never hold a number of an embedding or of a template.
 */

import { VeilfaceError } from "../errors.js";

/** Base of all errors between embeddings and a private template. */
export class TemplateError extends VeilfaceError {
  override name = "TemplateError";
}

/** A contract that is broken, or a pack or a generator of another one. */
export class ContractError extends TemplateError {
  override name = "ContractError";
}

/** A decoy generator that is broken, or whose decoys would hide nothing. */
export class DecoyError extends TemplateError {
  override name = "DecoyError";
}

/** A lift that cannot be made. */
export class LiftingError extends TemplateError {
  override name = "LiftingError";
}

/** The photos of one enrollment or probe do not all show the same person. */
export class InconsistentImages extends TemplateError {
  override name = "InconsistentImages";
  readonly code = "inconsistent_images";

  /**
   * @param apart positions from 0 of the photos that differ from the others.
   * @param others the other positions. Where both are as many, either may be the stranger's.
   */
  constructor(
    readonly apart: readonly number[],
    readonly others: readonly number[],
  ) {
    const differing =
      apart.length === 1 && others.length === 1
        ? `${listed([0, 1])} do not look like the same person`
        : `${listed(apart)} ${apart.length === 1 ? "does" : "do"} not look like the person on ${listed(others)}`;
    super(`${differing}; send photos of one person only, or clearer ones`);
  }

  /** The photos that differ, ascending: all of them where either half may. */
  get photos(): readonly number[] {
    if (this.apart.length < this.others.length) return this.apart;
    return [...this.apart, ...this.others].sort((a, b) => a - b);
  }
}

function listed(positions: readonly number[]): string {
  const numbers = positions.map((at) => String(at + 1));
  const last = numbers.pop();
  return numbers.length > 0 ? `photos ${numbers.join(", ")} and ${last}` : `photo ${last}`;
}
