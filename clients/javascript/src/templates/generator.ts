/** Decoys that belong to nobody, spread like real embeddings: `templates/decoys/generator.py`. */

import { sha256 } from "../bytes.js";
import { unusable } from "../errors.js";
import { normal } from "./samples.js";
import { dot, rowsOf } from "./subspace.js";

const SMALLEST_NORM = 1e-4;
// Decoys in a small subspace leave the hidden embedding the only direction outside it.
const SMALLEST_SHARE = 1 / 8;
const CHECKED_FROM = 64;
const TOLERANCE = 1e-3;
const MAX_HEADER = 64 * 1024;
const MAX_DIMENSION = 4096;
const LARGEST = 1e3;
const NAMES = ["axes", "mean", "root"] as const;

type Parts = Record<(typeof NAMES)[number], Float64Array>;

/** Draws embeddings of nobody from a Gaussian, in the coordinates of leading axes of faces. */
export class DecoyGenerator {
  private constructor(
    /** SHA-256 of the bytes, which the contract names. */
    readonly sourceId: string,
    /** Numbers of an embedding. */
    readonly n: number,
    /** Axes that embeddings are projected on: numbers of what is lifted, and of a decoy. */
    readonly k: number,
    /** The id of the embedding space that the embeddings of the fit were of, if it is known. */
    readonly madeWith: string | undefined,
    private readonly parts: Parts,
  ) {}

  /**
   * Read the answer of `GET /v1/contract/generator`; the bytes may be hostile.
   *
   * @throws `unusable_contract` if they are no generator, or one whose decoys would hide nothing.
   */
  static async fromBytes(bytes: Uint8Array): Promise<DecoyGenerator> {
    const { n, k, madeWith, parts } = read(bytes);
    requireSpread(parts, k);
    requireOrthonormal(parts.axes, k);
    return new DecoyGenerator(await sha256(bytes), n, k, madeWith, parts);
  }

  /** Take an embedding, n values of norm 1, to the k coordinates that templates have, of norm 1. */
  project(embedding: Float32Array): Float64Array {
    if (embedding.length !== this.n) {
      throw unusable(`an embedding has ${this.n} numbers, not ${embedding.length}`);
    }
    const point = Float64Array.from(embedding);
    if (!(Math.abs(Math.sqrt(dot(point, point)) - 1) <= TOLERANCE)) {
      throw unusable("an embedding must have norm 1; L2-normalise it");
    }
    const along = new Float64Array(this.k);
    rowsOf(this.parts.axes, this.k).forEach((row, i) => {
      for (let j = 0; j < this.k; j++) along[j] += point[i] * row[j];
    });
    return direction(along, "an embedding has no part along the axes of faces");
  }

  /** Draw `count` fresh decoys: unit rows of k values. */
  draw(count: number): Float64Array[] {
    const { mean, root } = this.parts;
    const lines = rowsOf(root, this.k);
    return rowsOf(normal(count * this.k), this.k).map((z) =>
      direction(
        mean.map((value, i) => value + dot(lines[i], z)),
        "the decoy generator makes vectors without a direction",
      ),
    );
  }
}

function direction(vector: Float64Array, otherwise: string): Float64Array {
  const norm = Math.sqrt(dot(vector, vector));
  if (!(norm > SMALLEST_NORM) || !Number.isFinite(norm)) throw unusable(otherwise);
  return vector.map((value) => value / norm);
}

/**
 * Refuse a root that is no lower Cholesky factor, and decoys that spread over too few axes: a
 * service could otherwise hand out a generator that hides nothing.
 */
function requireSpread({ axes, mean, root }: Parts, k: number): void {
  const within = (values: Float64Array): boolean => values.every((value) => Math.abs(value) <= LARGEST);
  if (![axes, mean, root].every(within)) {
    throw unusable("the decoy generator holds values that are out of range");
  }
  const lines = rowsOf(root, k);
  if (!lines.every((line, i) => line[i] > 0 && line.subarray(i + 1).every((value) => value === 0))) {
    throw unusable("the root of the decoy generator is no lower Cholesky factor");
  }
  // The sum of the deviations along principal axes is at least the trace of any root.
  const trace = lines.reduce((sum, line, i) => sum + line[i], 0);
  const spread = trace ** 2 / dot(root, root);
  if (k >= CHECKED_FROM && spread < SMALLEST_SHARE * k) {
    throw unusable(
      `the decoys would spread over ${spread.toFixed(0)} of ${k} axes, and would hide nothing`,
    );
  }
}

function requireOrthonormal(axes: Float64Array, k: number): void {
  const products = Array.from({ length: k }, () => new Float64Array(k));
  for (const row of rowsOf(axes, k)) {
    for (let i = 0; i < k; i++) {
      const [line, factor] = [products[i], row[i]];
      for (let j = 0; j <= i; j++) line[j] += factor * row[j];
    }
  }
  const isOne = (line: Float64Array, i: number): boolean =>
    line.every((value, j) => Math.abs(value - (i === j ? 1 : 0)) <= TOLERANCE);
  if (!products.every(isOne)) throw unusable("the axes of the decoy generator are not orthonormal");
}

/** Read the safetensors of a generator (docs/formats.md): three float32 arrays, and nothing else. */
function read(bytes: Uint8Array): { n: number; k: number; madeWith: string | undefined; parts: Parts } {
  const broken = unusable("this is not a decoy generator of version 2");
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const size = bytes.length < 8 ? Infinity : Number(view.getBigUint64(0, true));
  if (size > MAX_HEADER) throw broken;
  let header: Record<string, unknown>;
  let fields: Record<string, unknown>;
  let [n, k] = [0, 0];
  try {
    const text = new TextDecoder().decode(bytes.subarray(8, 8 + size));
    const { __metadata__: metadata, ...arrays } = JSON.parse(text);
    [header, fields, [n, k]] = [arrays, JSON.parse(metadata.veilface), arrays.axes.shape];
  } catch {
    // The parser's own words may quote the input.
    throw broken;
  }
  const { format, version, made_with: madeWith, ...others } = fields;
  const isUpTo = (value: number, most: number): boolean => Number.isInteger(value) && value >= 2 && value <= most;
  const isHash = typeof madeWith === "string" && /^[0-9a-f]{64}$/.test(madeWith);
  if (format !== "veilface decoy generator" || version !== 2 || Object.keys(others).length > 0) throw broken;
  if (!(isHash || madeWith === undefined) || !isUpTo(n, MAX_DIMENSION) || !isUpTo(k, n)) throw broken;
  const shapes = { axes: [n, k], mean: [k], root: [k, k] };
  const expected: Record<string, object> = {};
  let end = 0;
  for (const name of NAMES) {
    const start = end;
    end += 4 * shapes[name].reduce((product, side) => product * side, 1);
    expected[name] = { dtype: "F32", shape: shapes[name], data_offsets: [start, end] };
  }
  // Before the arrays: a hostile header could ask for some that are larger than memory.
  if (JSON.stringify(header) !== JSON.stringify(expected) || 8 + size + end !== bytes.length) {
    throw broken;
  }
  const numbers = Float64Array.from({ length: end / 4 }, (_, i) => view.getFloat32(8 + size + 4 * i, true));
  const [mean, root] = [n * k, n * k + k];
  const parts = {
    axes: numbers.subarray(0, mean),
    mean: numbers.subarray(mean, root),
    root: numbers.subarray(root),
  };
  return { n, k, madeWith: isHash ? madeWith : undefined, parts };
}
