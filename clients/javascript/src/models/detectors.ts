/**
 * What two families of face detectors take and give.
 *
 * SCRFD is that of the InsightFace packs (J. Guo et al., ICLR 2022), YuNet that of the OpenCV Zoo
 * (W. Wu, H. Peng, S. Yu, 2023).
 */

import { unusable } from "../errors.js";
import type { Face, Point } from "./faces.js";
import type { Tensor } from "./runtime.js";

const STRIDES = [8, 16, 32];
// exp of a wild regression must not overflow; 2**10 strides exceed any canvas.
const MAX_LOG_SIDE = 7.0;

/** One family of detectors with five points per face. */
export interface DetectorFamily {
  /** Whether a graph with these outputs is of the family. */
  readonly isOf: (outputs: readonly string[]) => boolean;
  /** The input is `(x - mean) * factor` of every channel, in this order. */
  readonly order: "rgb" | "bgr";
  readonly mean: number;
  readonly factor: number;
  /** Whether the canvas is no larger than the picture needs, and the picture never enlarged. */
  readonly trims: boolean;
  /** Intersection over union from which two boxes are one face. */
  readonly overlap: number;
  /** Score from which a photo serves. */
  readonly recommendedScore: number;
  /** Score from which the face is surely upright. */
  readonly clearScore: number;
  /** Faces on the canvas, with duplicates. */
  readonly candidates: (outputs: ReadonlyMap<string, Tensor>, size: readonly [number, number]) => Face[];
}

/** Scores, boxes and points of the cells of one stride, as they come. */
interface Cells {
  readonly score: (k: number) => number;
  readonly box: Float32Array;
  readonly points: Float32Array;
  readonly perCell: number;
}

/** Decode the cells of every stride whose score is enough; points are offsets in strides. */
function decoded(
  size: readonly [number, number],
  least: number,
  cellsOf: (stride: number, count: number) => Cells | undefined,
  boxOf: (x: number, y: number, values: Float32Array, stride: number) => Face["box"],
): Face[] {
  return STRIDES.flatMap((stride) => {
    const columns = Math.floor(size[1] / stride);
    const count = Math.floor(size[0] / stride) * columns;
    const cells = cellsOf(stride, count);
    if (cells === undefined) {
      throw unusable(`the detector's outputs at stride ${stride} do not fit its canvas`);
    }
    const faces: Face[] = [];
    for (let k = 0; k < count * cells.perCell; k++) {
      const score = cells.score(k);
      if (!(score >= least)) continue;
      const cell = Math.floor(k / cells.perCell);
      const [x, y] = [(cell % columns) * stride, Math.floor(cell / columns) * stride];
      const at = (j: number): Point => [
        x + cells.points[10 * k + 2 * j] * stride,
        y + cells.points[10 * k + 2 * j + 1] * stride,
      ];
      const box = boxOf(x, y, cells.box.subarray(4 * k, 4 * k + 4), stride);
      faces.push({ box, score, keypoints: [0, 1, 2, 3, 4].map(at) });
    }
    return faces;
  });
}

/** SCRFD with keypoints; boxes are distances from the cell in strides. */
export const SCRFD: DetectorFamily = {
  isOf: (outputs) => outputs.length === 9,
  order: "rgb",
  mean: 127.5,
  factor: 1 / 128,
  trims: false,
  overlap: 0.4,
  recommendedScore: 0.6,
  clearScore: 0.75,
  candidates(outputs, size) {
    // Exports differ in the order of the outputs and in a leading batch axis.
    const [scores, boxes, points] = [1, 4, 10].map((width) =>
      [...outputs.values()]
        .filter(({ dims }) => dims[dims.length - 1] === width)
        .map(({ data }) => data)
        .sort((a, b) => b.length - a.length),
    );
    const cellsOf = (stride: number, count: number): Cells | undefined => {
      const i = STRIDES.indexOf(stride);
      const [score, box, point] = [scores[i], boxes[i], points[i]];
      const perCell = (score?.length ?? 0) / count;
      const fits = Number.isInteger(perCell) && perCell >= 1 &&
        box?.length === 4 * score.length && point?.length === 10 * score.length;
      return fits ? { score: (k) => score[k], box, points: point, perCell } : undefined;
    };
    return decoded(size, 0.5, cellsOf, (x, y, [left, top, right, bottom], stride) =>
      [x - left * stride, y - top * stride, x + right * stride, y + bottom * stride]);
  },
};

const YUNET_OUTPUTS = ["cls", "obj", "bbox", "kps"].flatMap((role) =>
  STRIDES.map((stride) => `${role}_${stride}`),
);
const clipped = (value: number): number => Math.min(Math.max(value, 0), 1);

/** YuNet with five points; boxes are a centre and logarithms of the sides. */
export const YUNET: DetectorFamily = {
  isOf: (outputs) => YUNET_OUTPUTS.every((name) => outputs.includes(name)),
  order: "bgr",
  mean: 0,
  factor: 1,
  trims: true,
  overlap: 0.3,
  recommendedScore: 0.7,
  clearScore: 0.92,
  candidates(outputs, size) {
    const cellsOf = (stride: number, count: number): Cells | undefined => {
      const [cls, obj, box, points] = ["cls", "obj", "bbox", "kps"].map(
        (role) => outputs.get(`${role}_${stride}`)?.data ?? new Float32Array(0),
      );
      if (cls.length !== count || obj.length !== count) return undefined;
      const score = (k: number): number => Math.fround(Math.sqrt(clipped(cls[k]) * clipped(obj[k])));
      return { score, box, points, perCell: 1 };
    };
    return decoded(size, 0.6, cellsOf, (x, y, [dx, dy, logWidth, logHeight], stride) => {
      const [cx, cy] = [x + dx * stride, y + dy * stride];
      const half = (log: number): number => Math.exp(Math.min(log, MAX_LOG_SIDE)) * (stride / 2);
      const [w, h] = [half(logWidth), half(logHeight)];
      return [cx - w, cy - h, cx + w, cy + h];
    });
  },
};
