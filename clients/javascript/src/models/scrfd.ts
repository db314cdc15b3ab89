/** SCRFD, the detector of the InsightFace packs (J. Guo et al., ICLR 2022). */

import type { Face, Point } from "./boxes.js";
import {
  canvasSizes,
  facesFromCandidates,
  letterbox,
  type Detector,
  type Size,
} from "./detection.js";
import { PackError } from "./errors.js";
import type { RgbImage } from "./image.js";
import { planes, type Graph, type Tensor } from "./runtime.js";

const STRIDES = [8, 16, 32];
const SCORE_THRESHOLD = 0.5;
const OVERLAP = 0.4;

/** SCRFD with keypoints: scores, boxes and points, as distances from the cell in strides. */
export class Scrfd implements Detector {
  readonly kind = "scrfd";
  readonly recommendedScore = 0.6;
  readonly clearScore = 0.75;
  readonly isFixed: boolean;
  readonly sizes: readonly Size[];

  constructor(
    private readonly graph: Graph,
    size: number,
    fixed: Size | undefined,
  ) {
    this.isFixed = fixed !== undefined;
    this.sizes = canvasSizes(size, fixed);
  }

  canvas(_image: RgbImage, size: Size): Size {
    return size;
  }

  async detectOnce(image: RgbImage, size: Size): Promise<Face[]> {
    const { canvas, scale } = letterbox(image, size, true);
    const third = (value: number): number[] => [value, value, value];
    const blob = planes(canvas, "rgb", third(127.5), third(1 / 128));
    const outputs = await this.graph.run(blob, [1, 3, size[0], size[1]]);
    const candidates: Face[] = [];
    const [scores, distances, points] = [1, 4, 10].map((width) => ofWidth(outputs, width));
    STRIDES.forEach((stride, i) => {
      const columns = Math.floor(size[1] / stride);
      const cells = Math.floor(size[0] / stride) * columns;
      const [score, reach, point] = [scores[i], distances[i], points[i]];
      const perCell = score === undefined ? 0 : score.length / cells;
      if (
        !Number.isInteger(perCell) ||
        perCell < 1 ||
        reach?.length !== 4 * score.length ||
        point?.length !== 10 * score.length
      ) {
        throw new PackError(`the detector's outputs at stride ${stride} do not fit its canvas`);
      }
      for (let k = 0; k < score.length; k++) {
        if (!(score[k] >= SCORE_THRESHOLD)) continue;
        const cell = Math.floor(k / perCell);
        const [x, y] = [(cell % columns) * stride, Math.floor(cell / columns) * stride];
        const at = (j: number): Point => [
          x + point[10 * k + 2 * j] * stride,
          y + point[10 * k + 2 * j + 1] * stride,
        ];
        candidates.push({
          box: [
            x - reach[4 * k] * stride,
            y - reach[4 * k + 1] * stride,
            x + reach[4 * k + 2] * stride,
            y + reach[4 * k + 3] * stride,
          ],
          score: score[k],
          keypoints: [0, 1, 2, 3, 4].map(at),
        });
      }
    });
    return facesFromCandidates(candidates, OVERLAP, scale);
  }

  release(): Promise<void> {
    return this.graph.release();
  }
}

/**
 * The outputs with `width` values per cell, the finest stride first.
 *
 * Exports differ in the order of the outputs and in a leading batch axis.
 */
function ofWidth(outputs: ReadonlyMap<string, Tensor>, width: number): Float32Array[] {
  return [...outputs.values()]
    .filter((output) => output.dims[output.dims.length - 1] === width)
    .map((output) => output.data)
    .sort((a, b) => b.length - a.length);
}
