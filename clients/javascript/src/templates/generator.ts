/** Decoys that belong to nobody, spread like real descriptors: `templates/decoys/generator.py`. */

import { roundHalfEven } from "../models/image.js";
import { sha256 } from "../models/pack.js";
import { DecoyError } from "./errors.js";
import type { Keystream } from "./randomness.js";
import { rowsOf } from "./subspace.js";

const MAX_LEADING = 16;
const BAND_WIDTH = 32;
const SMALLEST_NORM = 1e-4;
// Decoys in a small subspace leave the hidden descriptor the only direction outside it.
const SMALLEST_SHARE = 1 / 8;
const CHECKED_FROM = 64;
const ORTHOGONAL = 1e-3;
const MAX_HEADER = 64 * 1024;
const MAX_DIMENSION = 4096;
const MAX_COMPONENTS = 64;
const LARGEST_NOISE = 0.1;
const LARGEST_SCALE = 1e3;
const SMALLEST_SCALE = 1e-6;
const LARGEST_LOG_ENERGY = 10;
// As the bytes have them.
const PARTS = ["axes", "centres", "mean", "spreads", "weights"] as const;

type Parts = Record<(typeof PARTS)[number], Float64Array>;

/** Number of axes that are modelled one by one. */
const leadingAxes = (n: number): number => Math.min(MAX_LEADING, Math.floor(n / 2));

/** First axis of every band, and n. */
function bandEdges(n: number): number[] {
  const first = leadingAxes(n);
  const bands = Math.max(1, roundHalfEven((n - first) / BAND_WIDTH));
  const step = (n - first) / bands;
  return Array.from({ length: bands + 1 }, (_, i) => roundHalfEven(first + i * step));
}

/** Draws descriptors of nobody from the statistics of real descriptors. */
export class DecoyGenerator {
  private constructor(
    /** SHA-256 of the bytes, which the contract names. */
    readonly sourceId: string,
    readonly n: number,
    /** The id of the embedding space that the descriptors of the fit were of, if it is told. */
    readonly madeWith: string | undefined,
    /** Variance of the noise that every number of a decoy gets, and of a lifted descriptor. */
    readonly noise: number,
    private readonly parts: Parts,
  ) {}

  /**
   * Read the answer of `GET /v1/contract/generator`; the bytes may be hostile.
   *
   * @throws DecoyError if they are no generator, or one whose decoys would hide nothing.
   */
  static async fromBytes(bytes: Uint8Array): Promise<DecoyGenerator> {
    const { n, madeWith, noise, parts } = readContainer(bytes);
    checkValues(parts, n);
    checkSpread(parts, n);
    return new DecoyGenerator(await sha256(bytes), n, madeWith, noise, parts);
  }

  /** Draw `k` fresh decoys: unit rows of float32 values. */
  draw(k: number, stream: Keystream): Float64Array[] {
    const { mean, axes, weights, centres, spreads } = this.parts;
    const n = this.n;
    const lead = leadingAxes(n);
    const edges = bandEdges(n);
    const q = lead + edges.length - 1;
    const uniform = stream.uniform(k);
    const features = rowsOf(stream.normal(k * q), q);
    const directions = rowsOf(stream.normal(k * (n - lead)), n - lead);
    const noise = this.noise > 0 ? stream.normal(k * n) : undefined;
    const deviation = Math.sqrt(this.noise);
    const rows = rowsOf(axes, n);
    return Array.from({ length: k }, (_, row) => {
      const component = chosen(weights, uniform[row]);
      const spread = rowsOf(spreads.subarray(component * q * q, (component + 1) * q * q), q);
      const feature = spread.map(
        (line, j) => centres[component * q + j] + dot(line, features[row]),
      );
      const x = Float64Array.from(mean);
      const addAxis = (axis: number, size: number): void => {
        const z = Math.fround(size);
        const along = rows[axis];
        for (let i = 0; i < n; i++) x[i] += z * along[i];
      };
      for (let axis = 0; axis < lead; axis++) addAxis(axis, feature[axis]);
      for (let band = 0; band + 1 < edges.length; band++) {
        const direction = directions[row].subarray(edges[band] - lead, edges[band + 1] - lead);
        const size =
          Math.exp(Math.min(Math.max(feature[lead + band], -20), 20)) /
          Math.sqrt(dot(direction, direction) / direction.length);
        direction.forEach((value, i) => addAxis(edges[band] + i, value * size));
      }
      for (let i = 0; i < n; i++) {
        x[i] = Math.fround(x[i]);
        if (noise !== undefined) x[i] += deviation * noise[row * n + i];
      }
      const norm = Math.sqrt(dot(x, x));
      if (!(norm > SMALLEST_NORM) || !Number.isFinite(norm)) {
        throw new DecoyError("the decoy generator makes vectors without a direction");
      }
      return x.map((value) => Math.fround(value / norm));
    });
  }
}

const dot = (a: Float64Array, b: Float64Array): number => a.reduce((s, v, i) => s + v * b[i], 0);

/** The component that a uniform number falls on; weights may add up to slightly less than 1. */
function chosen(weights: Float64Array, uniform: number): number {
  let total = 0;
  const component = weights.findIndex((weight) => uniform < (total += weight));
  return component < 0 ? weights.length - 1 : component;
}

function checkValues({ mean, axes, weights, centres, spreads }: Parts, n: number): void {
  const lead = leadingAxes(n);
  const q = lead + bandEdges(n).length - 1;
  const largest = (values: Float64Array): number =>
    values.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  if (
    ![mean, axes, weights, centres, spreads].every((part) => part.every(Number.isFinite)) ||
    [mean, axes, centres, spreads].some((part) => largest(part) > LARGEST_SCALE) ||
    largest(axes) < SMALLEST_SCALE ||
    largest(centres.filter((_, i) => i % q >= lead)) > LARGEST_LOG_ENERGY ||
    !weights.every((weight) => weight > 0) ||
    Math.abs(total - 1) > 1e-4
  ) {
    throw new DecoyError("the decoy generator holds values that are out of range");
  }
}

/**
 * Refuse axes that are not orthogonal, and decoys that spread over too few dimensions: a service
 * could otherwise hand out a generator that hides nothing.
 */
function checkSpread({ axes, weights, centres, spreads }: Parts, n: number): void {
  const rows = rowsOf(axes, n);
  const lengths = rows.map((row) => Math.sqrt(dot(row, row)));
  for (let i = 0; i < n; i++) {
    for (let j = 0; j < i; j++) {
      let product = 0;
      for (let k = 0; k < n; k++) product += rows[i][k] * rows[j][k];
      if (Math.abs(product) > ORTHOGONAL * lengths[i] * lengths[j]) {
        throw new DecoyError("the axes of the decoy generator are not orthogonal");
      }
    }
  }
  if (n < CHECKED_FROM) return;
  const lead = leadingAxes(n);
  const edges = bandEdges(n);
  const q = lead + edges.length - 1;
  // Mean square of every feature's coordinate: of the leading ones, then of the bands.
  const squares = new Float64Array(q);
  weights.forEach((weight, component) => {
    for (let j = 0; j < q; j++) {
      const start = (component * q + j) * q;
      const line = spreads.subarray(start, start + q);
      const variance = dot(line, line);
      const centre = centres[component * q + j];
      squares[j] +=
        weight *
        (j < lead ? centre ** 2 + variance : Math.exp(Math.min(2 * (centre + variance), 40)));
    }
  });
  let [sum, total] = [0, 0];
  let band = 0;
  for (let axis = 0; axis < n; axis++) {
    if (axis >= edges[band + 1]) band++;
    const sigma = lengths[axis] * Math.sqrt(squares[axis < lead ? axis : lead + band]);
    sum += sigma;
    total += sigma ** 2;
  }
  const participation = total > 0 ? sum ** 2 / total : 0;
  if (!(participation >= SMALLEST_SHARE * n)) {
    throw new DecoyError(
      `the decoys would spread over ${participation.toFixed(0)} of ${n} dimensions, and would ` +
        "hide nothing",
    );
  }
}

/** What a generator's bytes hold; refuses all that Python would not write byte for byte. */
function readContainer(bytes: Uint8Array): {
  n: number;
  madeWith: string | undefined;
  noise: number;
  parts: Parts;
} {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const size = bytes.length < 8 ? Infinity : Number(view.getBigUint64(0, true));
  if (size > Math.min(MAX_HEADER, bytes.length - 8)) {
    throw new DecoyError("the decoy generator is cut off, or no safetensors file");
  }
  let fields: Record<string, unknown>;
  let n: unknown;
  let count: unknown;
  try {
    const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + size)));
    fields = JSON.parse(header.__metadata__.veilface);
    [n, count] = [header.mean.shape[0], header.weights.shape[0]];
  } catch {
    // The parser's own words may quote the input.
    throw new DecoyError("the decoy generator is not a valid safetensors file of this kind");
  }
  if (!isUpTo(n, 2, MAX_DIMENSION) || !isUpTo(count, 1, MAX_COMPONENTS)) {
    throw new DecoyError(
      `a decoy generator has 2 to ${MAX_DIMENSION} dimensions and 1 to ${MAX_COMPONENTS} components`,
    );
  }
  const { format, version, made_with: madeWith, noise = "0.0", ...others } = fields;
  if (
    format !== "veilface decoy generator" ||
    version !== 1 ||
    !isNoise(noise) ||
    !(madeWith === undefined || (typeof madeWith === "string" && /^[0-9a-f]{64}$/.test(madeWith))) ||
    Object.keys(others).length > 0
  ) {
    throw new DecoyError("this is not a decoy generator of version 1");
  }
  const q = leadingAxes(n) + bandEdges(n).length - 1;
  const shapes = {
    axes: [n, n],
    centres: [count, q],
    mean: [n],
    spreads: [count, q, q],
    weights: [count],
  };
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
  return { n, madeWith, noise: Number(noise), parts: parts as Parts };
}

const isUpTo = (value: unknown, least: number, most: number): value is number =>
  Number.isInteger(value) && (value as number) >= least && (value as number) <= most;

/** Whether it is a variance from 0 to 0.1, written as Python writes it. */
function isNoise(value: unknown): value is string {
  const noise = typeof value === "string" ? Number(value) : NaN;
  if (!(noise >= 0 && noise <= LARGEST_NOISE)) return false;
  if (noise === 0) return value === "0.0";
  return value === (noise >= 1e-4 ? String(noise) : noise.toExponential().replace(/e-(\d)$/, "e-0$1"));
}
