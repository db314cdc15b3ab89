/** Decoys that belong to nobody, spread like real embeddings: `templates/decoys/generator.py`. */

import { sha256 } from "../models/pack.js";
import { DecoyError, LiftingError } from "./errors.js";
import type { Randomness } from "./randomness.js";
import { dot, rowsOf } from "./subspace.js";

const SMALLEST_NORM = 1e-4;
// Decoys in a small subspace leave the hidden embedding the only direction outside it.
const SMALLEST_SHARE = 1 / 8;
const CHECKED_FROM = 64;
const ORTHONORMAL = 1e-3;
const UNIT_TOLERANCE = 1e-3;
const MAX_HEADER = 64 * 1024;
const MAX_DIMENSION = 4096;
const LARGEST = 1e3;
// As the bytes have them.
const PARTS = ["axes", "mean", "root"] as const;

type Parts = Record<(typeof PARTS)[number], Float64Array>;

/** Draws embeddings of nobody from a Gaussian, in the coordinates of leading axes of faces. */
export class DecoyGenerator {
  private constructor(
    /** SHA-256 of the bytes, which the contract names. */
    readonly sourceId: string,
    /** Numbers of an embedding. */
    readonly n: number,
    /** Axes that embeddings are projected on: numbers of what is lifted, and of a decoy. */
    readonly k: number,
    /** The id of the embedding space that the embeddings of the fit were of, if it is told. */
    readonly madeWith: string | undefined,
    private readonly parts: Parts,
  ) {}

  /**
   * Read the answer of `GET /v1/contract/generator`; the bytes may be hostile.
   *
   * @throws DecoyError if they are no generator, or one whose decoys would hide nothing.
   */
  static async fromBytes(bytes: Uint8Array): Promise<DecoyGenerator> {
    const { n, k, madeWith, parts } = readContainer(bytes);
    checkValues(parts, k);
    checkAxes(parts.axes, k);
    return new DecoyGenerator(await sha256(bytes), n, k, madeWith, parts);
  }

  /**
   * Take an embedding, n values of norm 1, to the k coordinates that templates have, of norm 1.
   *
   * @throws LiftingError if it has not n values or not norm 1, or no part along the axes.
   */
  project(embedding: Float32Array): Float32Array {
    if (embedding.length !== this.n) {
      throw new LiftingError(`an embedding has ${this.n} numbers, not ${embedding.length}`);
    }
    const point = Float64Array.from(embedding);
    if (!(Math.abs(Math.sqrt(dot(point, point)) - 1) <= UNIT_TOLERANCE)) {
      throw new LiftingError("an embedding must have norm 1; L2-normalise it");
    }
    const along = new Float64Array(this.k);
    rowsOf(this.parts.axes, this.k).forEach((row, i) => {
      for (let j = 0; j < this.k; j++) along[j] += point[i] * row[j];
    });
    const norm = Math.sqrt(dot(along, along));
    if (!(norm > SMALLEST_NORM)) {
      throw new LiftingError("an embedding has no part along the axes of faces");
    }
    return Float32Array.from(along, (value) => value / norm);
  }

  /** Draw `count` fresh decoys: unit rows of k float32 values. */
  draw(count: number, randomness: Randomness): Float64Array[] {
    const { mean, root } = this.parts;
    const lines = rowsOf(root, this.k);
    return rowsOf(randomness.normal(count * this.k), this.k).map((z) => {
      const x = mean.map((value, i) => value + dot(lines[i], z));
      const norm = Math.sqrt(dot(x, x));
      if (!(norm > SMALLEST_NORM) || !Number.isFinite(norm)) {
        throw new DecoyError("the decoy generator makes vectors without a direction");
      }
      return x.map((value) => Math.fround(value / norm));
    });
  }
}

/**
 * Refuse a root that is no lower Cholesky factor, and decoys that spread over too few axes: a
 * service could otherwise hand out a generator that hides nothing.
 */
function checkValues({ axes, mean, root }: Parts, k: number): void {
  const within = (values: Float64Array): boolean =>
    values.every((value) => Number.isFinite(value) && Math.abs(value) <= LARGEST);
  if (!axes.every(Number.isFinite) || !within(mean) || !within(root)) {
    throw new DecoyError("the decoy generator holds values that are out of range");
  }
  const lines = rowsOf(root, k);
  if (!lines.every((line, i) => line[i] > 0 && line.subarray(i + 1).every((value) => value === 0))) {
    throw new DecoyError("the root of the decoy generator is no lower Cholesky factor");
  }
  // The sum of the deviations along principal axes is at least the trace of any root.
  const trace = lines.reduce((sum, line, i) => sum + line[i], 0);
  const spread = trace ** 2 / dot(root, root);
  if (k >= CHECKED_FROM && spread < SMALLEST_SHARE * k) {
    throw new DecoyError(
      `the decoys would spread over ${spread.toFixed(0)} of ${k} axes, and would hide nothing`,
    );
  }
}

function checkAxes(axes: Float64Array, k: number): void {
  const products = Array.from({ length: k }, () => new Float64Array(k));
  for (const row of rowsOf(axes, k)) {
    for (let i = 0; i < k; i++) {
      const [line, factor] = [products[i], row[i]];
      for (let j = 0; j <= i; j++) line[j] += factor * row[j];
    }
  }
  const orthonormal = products.every((line, i) =>
    line.every((value, j) => Math.abs(value - (i === j ? 1 : 0)) <= ORTHONORMAL),
  );
  if (!orthonormal) throw new DecoyError("the axes of the decoy generator are not orthonormal");
}

/** What a generator's bytes hold; refuses all that Python would not write byte for byte. */
function readContainer(bytes: Uint8Array): {
  n: number;
  k: number;
  madeWith: string | undefined;
  parts: Parts;
} {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const size = bytes.length < 8 ? Infinity : Number(view.getBigUint64(0, true));
  if (size > Math.min(MAX_HEADER, bytes.length - 8)) {
    throw new DecoyError("the decoy generator is cut off, or no safetensors file");
  }
  let fields: Record<string, unknown>;
  let n: unknown;
  let k: unknown;
  try {
    const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + size)));
    fields = JSON.parse(header.__metadata__.veilface);
    [n, k] = header.axes.shape;
  } catch {
    // The parser's own words may quote the input.
    throw new DecoyError("the decoy generator is not a valid safetensors file of this kind");
  }
  if (!isUpTo(n, 2, MAX_DIMENSION) || !isUpTo(k, 2, n)) {
    throw new DecoyError(
      `a decoy generator has 2 to ${MAX_DIMENSION} numbers and at most as many axes`,
    );
  }
  const { format, version, made_with: madeWith, ...others } = fields;
  if (
    format !== "veilface decoy generator" ||
    version !== 2 ||
    !(madeWith === undefined || (typeof madeWith === "string" && /^[0-9a-f]{64}$/.test(madeWith))) ||
    Object.keys(others).length > 0
  ) {
    throw new DecoyError("this is not a decoy generator of version 2");
  }
  const shapes = { axes: [n, k], mean: [k], root: [k, k] };
  const start = 8 + size;
  let end = 0;
  const entries: Record<string, object> = {};
  const parts: Partial<Parts> = {};
  for (const name of PARTS) {
    const from = end;
    const length = shapes[name].reduce((product, side) => product * side, 1);
    end += 4 * length;
    entries[name] = { dtype: "F32", shape: shapes[name], data_offsets: [from, end] };
    // Before the array: a hostile header could ask for one that is larger than memory.
    if (start + end > bytes.length) break;
    const at = (_: unknown, i: number): number => view.getFloat32(start + from + 4 * i, true);
    parts[name] = Float64Array.from({ length }, at);
  }
  const sortedFields = Object.fromEntries(Object.entries(fields).sort(([a], [b]) => (a < b ? -1 : 1)));
  const text = JSON.stringify({ __metadata__: { veilface: JSON.stringify(sortedFields) }, ...entries });
  const written = new TextEncoder().encode(text.padEnd(8 * Math.ceil(text.length / 8), " "));
  if (
    start + end !== bytes.length ||
    written.length !== size ||
    !written.every((byte, i) => byte === bytes[8 + i])
  ) {
    throw new DecoyError("the decoy generator is not in its one encoding, or its parts do not fit");
  }
  return { n, k, madeWith, parts: parts as Parts };
}

const isUpTo = (value: unknown, least: number, most: number): value is number =>
  Number.isInteger(value) && (value as number) >= least && (value as number) <= most;
