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
const PARTS = ["mean", "axes", "weights", "centres", "spreads"] as const;

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
    const { fields, tensors } = readContainer(bytes);
    const noise = fields["noise"] === undefined ? 0 : Number(fields["noise"]);
    const madeWith = fields["made_with"];
    if (
      fields["format"] !== "veilface decoy generator" ||
      fields["version"] !== 1 ||
      !(noise >= 0 && noise <= 0.1) ||
      (madeWith !== undefined && typeof madeWith !== "string")
    ) {
      throw new DecoyError("this is not a decoy generator of version 1");
    }
    const n = tensors.get("mean")?.length ?? 0;
    const count = tensors.get("weights")?.length ?? 0;
    const q = leadingAxes(n) + bandEdges(n).length - 1;
    const sizes = { mean: n, axes: n * n, weights: count, centres: count * q, spreads: count * q * q };
    if (n < 2 || count < 1 || PARTS.some((name) => tensors.get(name)?.length !== sizes[name])) {
      throw new DecoyError("the parts of the decoy generator do not fit each other");
    }
    const parts = Object.fromEntries(PARTS.map((name) => [name, tensors.get(name)])) as Parts;
    checkValues(parts);
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

function checkValues({ mean, axes, weights, centres, spreads }: Parts): void {
  const largest = (values: Float64Array): number =>
    values.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  if (
    ![mean, axes, weights, centres, spreads].every((part) => part.every(Number.isFinite)) ||
    [mean, axes, centres, spreads].some((part) => largest(part) > 1e3) ||
    largest(axes) < 1e-6 ||
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

/** The plain fields and the float32 tensors of a safetensors file of Veilface. */
function readContainer(bytes: Uint8Array): {
  fields: Record<string, unknown>;
  tensors: Map<string, Float64Array>;
} {
  try {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const start = 8 + Number(view.getBigUint64(0, true));
    const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, start))) as Record<
      string,
      { dtype?: string; data_offsets?: [number, number]; veilface?: string }
    >;
    const { __metadata__: metadata, ...entries } = header;
    const tensors = new Map<string, Float64Array>();
    for (const [name, { dtype, data_offsets: offsets }] of Object.entries(entries)) {
      if (dtype !== "F32" || offsets === undefined) throw new DecoyError("not float32");
      const at = (i: number): number => view.getFloat32(start + offsets[0] + 4 * i, true);
      const count = (offsets[1] - offsets[0]) / 4;
      // Before the array: a hostile header could ask for one that is larger than memory.
      if (!Number.isInteger(count) || start + offsets[1] > bytes.length) throw new RangeError();
      tensors.set(name, Float64Array.from({ length: count }, (_, i) => at(i)));
    }
    const fields = JSON.parse(metadata?.veilface ?? "") as Record<string, unknown>;
    return { fields, tensors };
  } catch {
    // The parser's own words may quote the input.
    throw new DecoyError("the decoy generator is not a valid safetensors file of this kind");
  }
}
