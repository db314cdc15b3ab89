/** Faces as boxes with five points: the value, its rank, and non-maximum suppression. */

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

// Greedy suppression is quadratic in what is kept, and no photo of a face needs more candidates.
const MAX_CANDIDATES = 1000;

export const boxWidth = (box: Box): number => box[2] - box[0];
export const boxHeight = (box: Box): number => box[3] - box[1];
export const boxArea = (box: Box): number =>
  Math.max(boxWidth(box), 0) * Math.max(boxHeight(box), 0);

export const shorterSide = (face: Face): number =>
  Math.min(boxWidth(face.box), boxHeight(face.box));

/** Rank of a face as the one that is meant: `area - 2 * ‖box centre - image centre‖²`. */
export function centreRank(face: Face, width: number, height: number): number {
  const dx = (face.box[0] + face.box[2]) / 2 - width / 2;
  const dy = (face.box[1] + face.box[3]) / 2 - height / 2;
  return boxArea(face.box) - 2 * (dx * dx + dy * dy);
}

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
