/** Face detectors, and which canvas speaks for which face: `models/detection.py`, where the reasons stand. */

import { unusable } from "../errors.js";
import { SCRFD, YUNET, type DetectorFamily } from "./detectors.js";
import { boxHeight, boxWidth, intersectionOverUnion, longerSide, nonMaximumSuppression } from "./faces.js";
import type { Box, Face, Point } from "./faces.js";
import { placed, resizeArea, resizeLinear, roundHalfEven, type RgbImage } from "./image.js";
import { planes, type Graph } from "./runtime.js";

export const DEFAULT_SIZE = 640;
const NEAR_SIZE = 320;
const SCOUT_SIZE = 128;
const LARGEST_FACE = 480;
const LARGE_SHARE = 0.25;
const SMALLEST_NEAR_FACE = 32;
const SAME_FACE = 0.4;
const RETRY_BORDER = 0.4;
const LEAST_SPREAD = 1.0;

/** Height and width. */
export type Size = readonly [number, number];

/** A detection graph with five points per face. */
export class Detector {
  readonly family: DetectorFamily;
  /** The canvas that the graph accepts, if it accepts no other. */
  readonly fixed: Size | undefined;
  /** The main canvas and, below it, the near one; only the graph's own where it has one. */
  readonly sizes: readonly Size[];

  /** @param size side of the main canvas, unless the graph fixes it. */
  constructor(
    private readonly graph: Graph,
    size: number,
  ) {
    const family = [YUNET, SCRFD].find(({ isOf }) => isOf(graph.outputNames));
    if (family === undefined) {
      throw unusable("the detector is neither SCRFD with five points nor YuNet");
    }
    this.family = family;
    const [, , height, width] = graph.inputShape;
    this.fixed = height !== undefined && width !== undefined ? [height, width] : undefined;
    const sides = size <= NEAR_SIZE ? [size] : [size, NEAR_SIZE];
    this.sizes = this.fixed ? [this.fixed] : sides.map((side): Size => [side, side]);
  }

  /** The canvas that a pass of `size` takes for `image`. */
  canvas(image: RgbImage, size: Size): Size {
    return this.family.trims ? (this.fixed ?? trimmed(image, size)) : size;
  }

  /** Find faces in one pass on a canvas of `size`, in pixels of `image`. */
  async detectOnce(image: RgbImage, asked: Size): Promise<Face[]> {
    const { family } = this;
    const size = this.canvas(image, asked);
    const { canvas, scale } = letterbox(image, size, !family.trims);
    const blob = planes(canvas, family.order, Array(3).fill(family.mean), Array(3).fill(family.factor));
    const outputs = await this.graph.run(blob, [1, 3, size[0], size[1]]);
    const kept = nonMaximumSuppression(family.candidates(outputs, size).filter(isSound), family.overlap);
    return kept.map((face) => moved(face, 1 / scale, 1 / scale, 0, 0));
  }

  release(): Promise<void> {
    return this.graph.release();
  }
}

/** A wild regression must not reach the alignment, which divides by the spread of the points. */
function isSound({ box, keypoints }: Face): boolean {
  const [xs, ys] = [0, 1].map((axis) => keypoints.map((point) => point[axis]));
  const spread = (values: number[]): number => Math.max(...values) - Math.min(...values);
  return (
    [...box, ...xs, ...ys].every(Number.isFinite) &&
    boxWidth(box) > 0 &&
    boxHeight(box) > 0 &&
    Math.max(spread(xs), spread(ys)) > LEAST_SPREAD
  );
}

/** Smallest canvas of whole 32-pixel blocks that holds the picture, at most `size`. */
function trimmed(image: RgbImage, size: Size): Size {
  const scale = Math.min(size[0] / image.height, size[1] / image.width, 1);
  const blocks = (side: number, most: number): number =>
    Math.min(most, Math.max(32, Math.ceil(roundHalfEven(side * scale) / 32) * 32));
  return [blocks(image.height, size[0]), blocks(image.width, size[1])];
}

/** Detect each face on the canvas that shows it at a size the detector knows, best score first. */
export async function findFaces(detector: Detector, image: RgbImage): Promise<Face[]> {
  const main = detector.sizes[0];
  const near = detector.sizes[detector.sizes.length - 1];
  const canvas = detector.canvas(image, main);
  const nearCanvas = detector.canvas(image, near);
  if (nearCanvas[0] === canvas[0] && nearCanvas[1] === canvas[1]) {
    const faces = await detector.detectOnce(image, main);
    return faces.length > 0 ? faces : insideBorder(detector, image, main);
  }
  const widest = Math.max(...canvas);
  const large = widest > LARGEST_FACE ? await largeFaces(detector, image) : [];
  const longest = Math.max(image.height, image.width);
  const sight = (LARGEST_FACE / widest) * longest;
  const blind = large.some((face) => longerSide(face) > sight);
  const sure = detector.family.recommendedScore;
  let onMain: Face[] = [];
  // Otherwise the near canvas shows all that such a picture has.
  if (!blind || longest > Math.max(...near)) {
    onMain = await detector.detectOnce(image, main);
    const certain = onMain.filter((face) => face.score >= sure);
    if (onMain.length > 0 && !blind && large.every((face) => among(face, certain))) return onMain;
  }
  const onNear = await detector.detectOnce(image, near);
  if (onNear.length === 0) {
    if (blind && onMain.length === 0) onMain = await detector.detectOnce(image, main);
    return onMain.length > 0 ? onMain : insideBorder(detector, image, main);
  }
  const limit = (SMALLEST_NEAR_FACE / Math.max(...near)) * longest;
  const faces = onMain.filter((face) => longerSide(face) < limit || (face.score >= sure && !blind));
  for (const face of onNear) if (!among(face, faces)) faces.push(face);
  return faces.sort((a, b) => b.score - a.score);
}

/** Faces of at least `LARGE_SHARE` of the picture, from a quick pass on a small canvas. */
async function largeFaces(detector: Detector, image: RgbImage): Promise<Face[]> {
  const small = shrunk(image, 2 * SCOUT_SIZE);
  const shrink = Math.min(1, SCOUT_SIZE / Math.max(small.height, small.width));
  const height = Math.max(1, roundHalfEven(small.height * shrink));
  const width = Math.max(1, roundHalfEven(small.width * shrink));
  const scout = resizeArea(small, width, height);
  const faces = await detector.detectOnce(scout, [SCOUT_SIZE, SCOUT_SIZE]);
  return faces
    .filter((face) => longerSide(face) >= LARGE_SHARE * Math.max(height, width))
    .map((face) => moved(face, image.width / width, image.height / height, 0, 0));
}

/** Whether one of `others` is the same face. */
const among = (face: Face, others: readonly Face[]): boolean =>
  others.some((other) => intersectionOverUnion(face.box, other.box) > SAME_FACE);

/** Faces found with a black border around the picture, in pixels of `image`. */
async function insideBorder(detector: Detector, image: RgbImage, main: Size): Promise<Face[]> {
  const small = shrunk(image, Math.max(...main));
  const fy = small.height / image.height;
  const fx = small.width / image.width;
  const top = roundHalfEven(roundHalfEven(image.height * RETRY_BORDER) * fy);
  const left = roundHalfEven(roundHalfEven(image.width * RETRY_BORDER) * fx);
  const bordered = placed(small, small.width + 2 * left, small.height + 2 * top, top, left);
  const faces = await detector.detectOnce(bordered, main);
  return faces.map((face) => moved(face, 1 / fx, 1 / fy, left, top));
}

/** A face whose x became `(x - left) * fx`, and whose y `(y - top) * fy`. */
function moved(face: Face, fx: number, fy: number, left: number, top: number): Face {
  const point = (x: number, y: number): Point => [(x - left) * fx, (y - top) * fy];
  const [x1, y1, x2, y2] = face.box;
  return {
    score: face.score,
    box: [...point(x1, y1), ...point(x2, y2)] as Box,
    keypoints: face.keypoints.map(([x, y]) => point(x, y)),
  };
}

/** The picture with a longer side of at most `longest` pixels. */
function shrunk(image: RgbImage, longest: number): RgbImage {
  const shrink = Math.min(1, longest / Math.max(image.height, image.width));
  const height = Math.max(1, roundHalfEven(image.height * shrink));
  return resizeLinear(image, Math.max(1, roundHalfEven(image.width * shrink)), height);
}

/**
 * Resize into the top-left corner of a black canvas, keeping the aspect ratio.
 *
 * The sides are cut to whole pixels and the scale is that of the cut height, as InsightFace does.
 *
 * @param enlarge whether a picture smaller than the canvas is enlarged to fill it.
 * @returns the canvas, and canvas pixels per image pixel.
 */
export function letterbox(image: RgbImage, size: Size, enlarge: boolean): { canvas: RgbImage; scale: number } {
  const ratio = image.height / image.width;
  let [height, width] = [image.height, image.width];
  if (enlarge || height > size[0] || width > size[1]) {
    const tall = ratio > size[0] / size[1];
    height = tall ? size[0] : Math.max(1, Math.floor(size[1] * ratio));
    width = tall ? Math.max(1, Math.floor(size[0] / ratio)) : size[1];
  }
  const resized = resizeLinear(image, width, height);
  return { canvas: placed(resized, size[1], size[0]), scale: height / image.height };
}
