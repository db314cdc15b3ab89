/** Detected faces: the value, boxes, and which face of a photo is meant. */

import { VeilfaceError } from "../errors.js";

/** x1, y1, x2, y2 in pixels. */
export type Box = readonly [number, number, number, number];

/** x, y in pixels. */
export type Point = readonly [number, number];

/** One detected face, in pixels of the upright image. */
export interface Face {
  /** May reach over the image's border. */
  readonly box: Box;
  /** Confidence of the detector, 0…1; detectors differ in what a value means. */
  readonly score: number;
  /** Left eye, right eye, nose, left and right mouth corner as the viewer sees them. */
  readonly keypoints: readonly Point[];
}

/**
 * What a photo with several faces means.
 *
 * `dominant` is the largest face, where it covers the middle of the picture and has at least twice
 * the area of every other; `largest` the largest wherever it is, where it has 1.25 times the area;
 * `single` none of them.
 */
export type FacePolicy = "dominant" | "largest" | "single";

// Greedy suppression is quadratic in what is kept, and no photo of a face needs more candidates.
const MAX_CANDIDATES = 1000;
// As in `models/selection.py`.
const DOMINANCE = 2;
const LARGER = 1.25;
export const boxWidth = (box: Box): number => box[2] - box[0];
export const boxHeight = (box: Box): number => box[3] - box[1];
export const shorterSide = ({ box }: Face): number => Math.min(boxWidth(box), boxHeight(box));
export const longerSide = ({ box }: Face): number => Math.max(boxWidth(box), boxHeight(box));
const boxArea = (box: Box): number => Math.max(boxWidth(box), 0) * Math.max(boxHeight(box), 0);

/** Shared area of two boxes over the area they cover together, 0…1. */
export function intersectionOverUnion(first: Box, second: Box): number {
  const width = Math.min(first[2], second[2]) - Math.max(first[0], second[0]);
  const height = Math.min(first[3], second[3]) - Math.max(first[1], second[1]);
  const shared = Math.max(width, 0) * Math.max(height, 0);
  return shared / (boxArea(first) + boxArea(second) - shared);
}

/** Drop faces whose box overlaps a better one by more than `threshold`; best score first. */
export function nonMaximumSuppression(faces: readonly Face[], threshold: number): Face[] {
  const kept: Face[] = [];
  const best = [...faces].sort((a, b) => b.score - a.score).slice(0, MAX_CANDIDATES);
  for (const face of best) {
    if (kept.every((other) => intersectionOverUnion(face.box, other.box) <= threshold)) {
      kept.push(face);
    }
  }
  return kept;
}

/**
 * The face that is meant.
 *
 * @param size width and height of the picture.
 * @param least shorter side of the box from which a face counts.
 */
export function selectFace(
  faces: readonly Face[],
  policy: FacePolicy,
  { width, height }: { readonly width: number; readonly height: number },
  least: number,
): Face {
  if (faces.length === 0) throw new VeilfaceError("no_face", "No face was found.");
  const byArea = [...faces].sort((a, b) => boxArea(b.box) - boxArea(a.box));
  const counted = byArea.filter((face) => shorterSide(face) >= least);
  const [main, other] = counted.length > 0 ? counted : byArea.slice(0, 1);
  if (other === undefined) return main;
  const [x1, y1, x2, y2] = main.box;
  const coversMiddle = x1 <= width / 2 && width / 2 <= x2 && y1 <= height / 2 && height / 2 <= y2;
  const ratio = boxArea(main.box) / boxArea(other.box);
  if (policy === "dominant" && ratio >= DOMINANCE && coversMiddle) return main;
  if (policy === "largest" && ratio >= LARGER) return main;
  const message = `The photo shows ${counted.length} faces, and it is not clear which one is meant.`;
  throw new VeilfaceError("multiple_faces", message, { details: { faces: counted.length } });
}
