/** YuNet, the detector of the OpenCV Zoo (W. Wu, H. Peng, S. Yu, 2023). */

import type { Face, Point } from "./boxes.js";
import {
  canvasSizes,
  facesFromCandidates,
  letterbox,
  type Detector,
  type Size,
} from "./detection.js";
import { PackError } from "./errors.js";
import { roundHalfEven, type RgbImage } from "./image.js";
import { planes, type Graph } from "./runtime.js";

const STRIDES = [8, 16, 32];
const SCORE_THRESHOLD = 0.6;
const OVERLAP = 0.3;
// exp of a wild regression must not overflow; 2**10 strides exceed any canvas.
const MAX_LOG_SIDE = 7.0;

/** The outputs that only YuNet has. */
export const YUNET_OUTPUTS: readonly string[] = ["cls", "obj", "bbox", "kps"].flatMap((role) =>
  STRIDES.map((stride) => `${role}_${stride}`),
);

/** YuNet with five points. */
export class YuNet implements Detector {
  readonly kind = "yunet";
  readonly recommendedScore = 0.7;
  readonly clearScore = 0.92;
  readonly isFixed: boolean;
  readonly sizes: readonly Size[];

  constructor(
    private readonly graph: Graph,
    size: number,
    private readonly fixed: Size | undefined,
  ) {
    this.isFixed = fixed !== undefined;
    this.sizes = canvasSizes(size, fixed);
  }

  /** No larger than the picture needs, unless the graph fixes it. */
  canvas(image: RgbImage, size: Size): Size {
    return this.fixed ?? trimmed(image, size);
  }

  async detectOnce(image: RgbImage, asked: Size): Promise<Face[]> {
    const size = this.canvas(image, asked);
    const { canvas, scale } = letterbox(image, size, false);
    const blob = planes(canvas, "bgr", [0, 0, 0], [1, 1, 1]);
    const outputs = await this.graph.run(blob, [1, 3, size[0], size[1]]);
    const candidates: Face[] = [];
    for (const stride of STRIDES) {
      const columns = Math.floor(size[1] / stride);
      const cells = Math.floor(size[0] / stride) * columns;
      const [cls, obj, box, kps] = ["cls", "obj", "bbox", "kps"].map(
        (role) => outputs.get(`${role}_${stride}`)?.data ?? new Float32Array(0),
      );
      if (cls.length !== cells || obj.length !== cells) {
        throw new PackError(`the detector's outputs at stride ${stride} do not fit its canvas`);
      }
      for (let k = 0; k < cells; k++) {
        const score = Math.fround(Math.sqrt(clipped(cls[k]) * clipped(obj[k])));
        if (!(score >= SCORE_THRESHOLD)) continue;
        const [x, y] = [(k % columns) * stride, Math.floor(k / columns) * stride];
        const [cx, cy] = [x + box[4 * k] * stride, y + box[4 * k + 1] * stride];
        const half = (log: number): number => Math.exp(Math.min(log, MAX_LOG_SIDE)) * (stride / 2);
        const [w, h] = [half(box[4 * k + 2]), half(box[4 * k + 3])];
        const at = (j: number): Point => [
          x + kps[10 * k + 2 * j] * stride,
          y + kps[10 * k + 2 * j + 1] * stride,
        ];
        candidates.push({
          box: [cx - w, cy - h, cx + w, cy + h],
          score,
          keypoints: [0, 1, 2, 3, 4].map(at),
        });
      }
    }
    return facesFromCandidates(candidates, OVERLAP, scale);
  }

  release(): Promise<void> {
    return this.graph.release();
  }
}

const clipped = (value: number): number => Math.min(Math.max(value, 0), 1);

/** Smallest canvas of whole 32-pixel blocks that holds the picture, at most `size`. */
function trimmed(image: RgbImage, size: Size): Size {
  const scale = Math.min(size[0] / image.height, size[1] / image.width, 1);
  const blocks = (side: number): number =>
    Math.max(32, Math.ceil(roundHalfEven(side * scale) / 32) * 32);
  return [
    Math.min(size[0], blocks(image.height)),
    Math.min(size[1], blocks(image.width)),
  ];
}
