/** Aligned crops → unit embeddings, by an ArcFace-like graph. */

import { unusable } from "../errors.js";
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

/** Embed an aligned crop of the preprocessing's size: n values of unit norm. */
export async function embed(graph: Graph, crop: RgbImage, how: Preprocessing): Promise<Float32Array> {
  const sum = await rawOutput(graph, crop, how);
  if (how.flip) {
    const other = await rawOutput(graph, mirrored(crop), how);
    sum.forEach((value, i) => (sum[i] = value + other[i]));
  }
  const norm = Math.sqrt(sum.reduce((total, value) => total + value * value, 0));
  if (!(norm > 0) || !Number.isFinite(norm)) {
    throw unusable("the embedder's output for a crop is zero or not finite");
  }
  return sum.map((value) => value / norm);
}

async function rawOutput(graph: Graph, crop: RgbImage, how: Preprocessing): Promise<Float32Array> {
  const one = planes(crop, how.channel_order, how.mean, how.scale.map((value) => 1 / value));
  // A graph with a fixed batch gets it filled up with zeros.
  const batch = graph.inputShape[0] ?? 1;
  const blob = new Float32Array(batch * one.length);
  blob.set(one);
  const [output] = (await graph.run(blob, [batch, 3, crop.height, crop.width])).values();
  if (output?.dims.length !== 2 || output.dims[0] !== batch) {
    throw unusable("the embedder must give one row of numbers for a crop");
  }
  return output.data.slice(0, output.dims[1]);
}

function mirrored(crop: RgbImage): RgbImage {
  const data = new Uint8Array(crop.data.length);
  for (let y = 0; y < crop.height; y++) {
    for (let x = 0; x < crop.width; x++) {
      const from = 3 * (y * crop.width + x);
      data.set(crop.data.subarray(from, from + 3), 3 * (y * crop.width + crop.width - 1 - x));
    }
  }
  return { ...crop, data };
}
