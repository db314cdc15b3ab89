/** The private template: an affine subspace in a form that shows nothing but the set, and its bytes. */

import { concealed } from "../bytes.js";
import { unusable } from "../errors.js";
import { normal } from "./samples.js";

/** One private template, foot + span(basis). Printing it shows no number of it. */
export interface AffineSubspace {
  /** Foot point, k values, orthogonal to the basis. */
  readonly foot: Float32Array;
  /** Orthonormal rows: m · k values, row by row. */
  readonly basis: Float32Array;
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
export const rowsOf = (values: Float64Array, columns: number): Float64Array[] =>
  Array.from({ length: values.length / columns }, (_, i) => values.subarray(i * columns, (i + 1) * columns));

/**
 * Orthonormalise rows in order by the Gram–Schmidt process; every row keeps its direction's sign.
 *
 * Each row is projected twice, which is as accurate as Householder's method (Giraud et al. 2005).
 * Throws `unusable_contract` where a row lies in the span of those before it, or is zero.
 */
export function orthonormalised(rows: readonly Float64Array[]): Float64Array[] {
  const done: Float64Array[] = [];
  for (const row of rows) {
    const next = Float64Array.from(row);
    const scaled = (least: number): void => {
      const length = Math.sqrt(dot(next, next));
      if (!(length > least)) {
        throw unusable("the directions of a subspace are linearly dependent: draw others");
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
export function templateThrough(point: Float64Array, directions: readonly Float64Array[]): AffineSubspace {
  const [m, k] = [directions.length, point.length];
  const frame = rowsOf(normal(m * k), k);
  const span = orthonormalised(directions);
  const foot = Float64Array.from(point);
  for (let twice = 0; twice < 2; twice++) {
    for (const row of span) add(foot, -dot(foot, row), row);
  }
  const turn = orthonormalised(rowsOf(normal(m * m), m));
  const projected = frame.map((row) => Float64Array.from(span, (other) => dot(row, other)));
  const basis = new Float32Array(m * k);
  combined(combined(turn, orthonormalised(projected)), span).forEach((row, i) => basis.set(row, i * k));
  return concealed({ foot: Float32Array.from(foot), basis }, "foot", "basis");
}

/** The product of two matrices by their rows. */
function combined(weights: readonly Float64Array[], rows: readonly Float64Array[]): Float64Array[] {
  return weights.map((weight) => {
    const sum = new Float64Array(rows[0].length);
    rows.forEach((row, i) => add(sum, weight[i], row));
    return sum;
  });
}

/** The bytes of a template on the wire (docs/formats.md): safetensors with one canonical header, float16. */
export function encode({ foot, basis }: AffineSubspace, contractId: string): Uint8Array {
  const [k, m] = [foot.length, basis.length / foot.length];
  const [split, end] = [2 * k, 2 * k * (m + 1)];
  const header = JSON.stringify({
    __metadata__: { format: "veilface-template", version: "1", contract_id: contractId },
    foot: { dtype: "F16", shape: [k], data_offsets: [0, split] },
    basis: { dtype: "F16", shape: [m, k], data_offsets: [split, end] },
  });
  const text = new TextEncoder().encode(header.padEnd(8 * Math.ceil(header.length / 8), " "));
  const bytes = new Uint8Array(8 + text.length + end);
  const view = new DataView(bytes.buffer);
  view.setBigUint64(0, BigInt(text.length), true);
  bytes.set(text, 8);
  [...foot, ...basis].forEach((value, i) => {
    view.setUint16(8 + text.length + 2 * i, float16(value), true);
  });
  return bytes;
}

/** Bits of the nearest float16 to a number of at most 1 in size, halves to the even one. */
export function float16(value: number): number {
  const sign = value < 0 || Object.is(value, -0) ? 0x8000 : 0;
  const size = Math.abs(value);
  // Below 2**-14 steps are 2**-24; above they grow with the exponent.
  const exponent = size < 2 ** -14 ? -14 : Math.floor(Math.log2(size));
  const scaled = size / 2 ** (exponent - 10);
  const low = Math.floor(scaled);
  const share = scaled - low;
  const steps = share > 0.5 || (share === 0.5 && low % 2 === 1) ? low + 1 : low;
  // A carry out of the steps raises the exponent, as the bits are laid out for it.
  return sign | (((exponent + 14) << 10) + steps);
}
