/** The private template: an affine subspace in a form that shows nothing but the set. */

import { LiftingError } from "./errors.js";
import type { Randomness } from "./randomness.js";

/** One private template, foot + span(basis). Printing it shows no number of it. */
export class AffineSubspace {
  readonly #foot: Float32Array;
  readonly #basis: Float32Array;

  constructor(foot: Float32Array, basis: Float32Array) {
    this.#foot = foot;
    this.#basis = basis;
  }

  /** Foot point, k values, orthogonal to the basis. */
  get foot(): Float32Array {
    return this.#foot;
  }

  /** Orthonormal rows: m · k values, row by row. */
  get basis(): Float32Array {
    return this.#basis;
  }
}

// Directions closer than this to the span of the others, relative to their length, are noise.
const LEAST_PIVOT = 1e-5;

/** The scalar product. */
export const dot = (a: Float64Array, b: Float64Array): number => {
  let sum = 0;
  for (let i = 0; i < a.length; i++) sum += a[i] * b[i];
  return sum;
};

/** Add `factor * row` to `to`. */
const add = (to: Float64Array, factor: number, row: Float64Array): void => {
  for (let i = 0; i < to.length; i++) to[i] += factor * row[i];
};

/** Rows of a matrix, as views. */
export function rowsOf(values: Float64Array, columns: number): Float64Array[] {
  return Array.from({ length: values.length / columns }, (_, i) =>
    values.subarray(i * columns, (i + 1) * columns),
  );
}

/**
 * Orthonormalise rows in order by the Gram–Schmidt process; every row keeps its direction's sign.
 *
 * Each row is projected twice, which is as accurate as Householder's method (Giraud et al. 2005).
 * Throws `LiftingError` where a row lies in the span of those before it, or is zero.
 */
export function orthonormalised(rows: readonly Float64Array[]): Float64Array[] {
  const done: Float64Array[] = [];
  for (const row of rows) {
    const next = Float64Array.from(row);
    const scaled = (least: number): void => {
      const length = Math.sqrt(dot(next, next));
      if (!(length > least)) {
        throw new LiftingError("the directions of a subspace are linearly dependent: draw others");
      }
      next.forEach((value, i) => (next[i] = value / length));
    };
    scaled(0);
    for (const other of done) add(next, -dot(next, other), other);
    scaled(LEAST_PIVOT);
    for (const other of done) add(next, -dot(next, other), other);
    scaled(0);
    done.push(next);
  }
  return done;
}

/**
 * The template of `point + span(directions)`.
 *
 * The basis is O · GS(Π G): G a Gaussian frame, Π the projection on the direction space, GS the
 * Gram–Schmidt process, O an orthogonal matrix by Haar's measure. So it depends on the set and on
 * the samples alone, not on the embedding, nor on the decoys one by one (docs/method.md §2.2).
 * All of it is float64; the result is rounded to float32.
 */
export function templateThrough(
  point: Float64Array,
  directions: readonly Float64Array[],
  randomness: Randomness,
): AffineSubspace {
  const [m, k] = [directions.length, point.length];
  const frame = rowsOf(randomness.normal(m * k), k);
  const span = orthonormalised(directions);
  const foot = Float64Array.from(point);
  for (let twice = 0; twice < 2; twice++) {
    for (const row of span) add(foot, -dot(foot, row), row);
  }
  const turn = orthonormalised(rowsOf(randomness.normal(m * m), m));
  const projected = frame.map((row) => Float64Array.from(span, (other) => dot(row, other)));
  const basis = combined(combined(turn, orthonormalised(projected)), span);
  const stored = new Float32Array(m * k);
  basis.forEach((row, i) => stored.set(row, i * k));
  return new AffineSubspace(Float32Array.from(foot), stored);
}

/** The product of two matrices by their rows. */
function combined(weights: readonly Float64Array[], rows: readonly Float64Array[]): Float64Array[] {
  return weights.map((weight) => {
    const sum = new Float64Array(rows[0].length);
    rows.forEach((row, i) => add(sum, weight[i], row));
    return sum;
  });
}
