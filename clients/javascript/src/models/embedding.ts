/** Aligned crops → unit embeddings, by an ArcFace-like graph. */

import { ModelError } from "./errors.js";
import type { RgbImage } from "./image.js";
import { planes, type Graph } from "./runtime.js";

/** What happens to a crop before the graph sees it, as the contract binds it. */
export interface Preprocessing {
  readonly version: number;
  readonly alignment: string;
  readonly size: number;
  readonly channel_order: "rgb" | "bgr";
  /** The input is `(x - mean) / scale` of each channel. */
  readonly mean: readonly number[];
  readonly scale: readonly number[];
  /** Whether the embedding of the mirrored crop is added. */
  readonly flip: boolean;
}

/** The version of the way from a photo to its crop that this package goes. */
export const PREPROCESSING_VERSION = 2;

/** An embedding graph with its preprocessing. */
export class Embedder {
  constructor(
    private readonly graph: Graph,
    readonly preprocessing: Preprocessing,
  ) {}

  /** Embed an aligned crop: n values of unit norm. */
  async embed(crop: RgbImage): Promise<Float32Array> {
    const { size, flip } = this.preprocessing;
    if (crop.width !== size || crop.height !== size) {
      throw new ModelError(`an aligned crop must have ${size} x ${size} pixels`);
    }
    const raw = await this.raw(crop);
    if (flip) {
      const other = await this.raw(mirrored(crop));
      raw.forEach((value, i) => (raw[i] = value + other[i]));
    }
    const norm = Math.sqrt(raw.reduce((sum, value) => sum + value * value, 0));
    if (!(norm > 0) || !Number.isFinite(norm)) {
      throw new ModelError("the embedder's output for a crop is zero or not finite");
    }
    return raw.map((value) => value / norm);
  }

  release(): Promise<void> {
    return this.graph.release();
  }

  private async raw(crop: RgbImage): Promise<Float32Array> {
    const { size, channel_order, mean, scale } = this.preprocessing;
    const one = planes(
      crop,
      channel_order,
      mean,
      scale.map((value) => 1 / value),
    );
    // A graph with a fixed batch gets it filled up with zeros.
    const batch = this.graph.inputShape[0] ?? 1;
    const blob = new Float32Array(batch * one.length);
    blob.set(one);
    const [output] = (await this.graph.run(blob, [batch, 3, size, size])).values();
    if (output?.dims.length !== 2 || output.dims[0] !== batch) {
      throw new ModelError("the embedder must give one row of numbers for a crop");
    }
    return output.data.slice(0, output.dims[1]);
  }
}

function mirrored(crop: RgbImage): RgbImage {
  const data = new Uint8Array(crop.data.length);
  for (let y = 0; y < crop.height; y++) {
    for (let x = 0; x < crop.width; x++) {
      const from = 3 * (y * crop.width + x);
      const to = 3 * (y * crop.width + crop.width - 1 - x);
      data.set(crop.data.subarray(from, from + 3), to);
    }
  }
  return { ...crop, data };
}
