/** What every face detector does alike: the canvas, and which canvas speaks for which face. */

import {
  boxHeight,
  boxWidth,
  intersectionOverUnion,
  nonMaximumSuppression,
  type Box,
  type Face,
  type Point,
} from "./boxes.js";
import { placed, resizeArea, resizeLinear, roundHalfEven, type RgbImage } from "./image.js";

export const DEFAULT_SIZE = 640;
// As in `models/detection.py`, where the reason for each number stands.
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

/** A face detector with five points per face. */
export interface Detector {
  readonly kind: "scrfd" | "yunet";
  readonly sizes: readonly Size[];
  readonly recommendedScore: number;
  readonly clearScore: number;
  /** Whether the graph accepts no other canvas. */
  readonly isFixed: boolean;
  /** The canvas that a pass of `size` really takes for `image`. */
  canvas(image: RgbImage, size: Size): Size;
  /** Faces found in one pass on a canvas of `size`, in pixels of `image`. */
  detectOnce(image: RgbImage, size: Size): Promise<Face[]>;
  release(): Promise<void>;
}

/** The main canvas and, below it, the near one; only the graph's own where it has one. */
export function canvasSizes(size: number, fixed: Size | undefined): readonly Size[] {
  if (fixed !== undefined) return [fixed];
  const main: Size = [size, size];
  return size <= NEAR_SIZE ? [main] : [main, [NEAR_SIZE, NEAR_SIZE]];
}

/**
 * Detect each face on the canvas that shows it at a size the detector knows, best score first.
 *
 * The rule, and why it is so, is that of `find_faces` in `models/detection.py`.
 */
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
  const sure = detector.recommendedScore;
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
  const faces = onMain.filter(
    (face) => longerSide(face) < limit || (face.score >= sure && !blind),
  );
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
function among(face: Face, others: readonly Face[]): boolean {
  return others.some((other) => intersectionOverUnion(face.box, other.box) > SAME_FACE);
}

const longerSide = (face: Face): number => Math.max(boxWidth(face.box), boxHeight(face.box));

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
export function letterbox(
  image: RgbImage,
  size: Size,
  enlarge: boolean,
): { canvas: RgbImage; scale: number } {
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

/** Drop candidates that are not sound, suppress duplicates, return to image pixels. */
export function facesFromCandidates(
  candidates: readonly Face[],
  overlap: number,
  scale: number,
): Face[] {
  const kept = nonMaximumSuppression(candidates.filter(isSound), overlap);
  return kept.map((face) => moved(face, 1 / scale, 1 / scale, 0, 0));
}

/** A wild regression must not reach the alignment, which divides by the spread of the points. */
function isSound(face: Face): boolean {
  const [xs, ys] = [0, 1].map((axis) => face.keypoints.map((point) => point[axis]));
  const spread = (values: number[]): number => Math.max(...values) - Math.min(...values);
  return (
    [...face.box, ...xs, ...ys].every(Number.isFinite) &&
    boxWidth(face.box) > 0 &&
    boxHeight(face.box) > 0 &&
    Math.max(spread(xs), spread(ys)) > LEAST_SPREAD
  );
}
