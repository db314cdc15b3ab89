/** Warp a face onto the common five-point template of ArcFace. */

import { unusable } from "../errors.js";
import type { Point } from "./faces.js";
import { warpAffine, type Affine, type RgbImage } from "./image.js";

// Left eye, right eye, nose, left and right mouth corner as the viewer sees them, for 112 x 112.
const TEMPLATE_112: readonly Point[] = [
  [38.2946, 51.6963], [73.5318, 51.5014], [56.0252, 71.7366], [41.5493, 92.3655], [70.7299, 92.2041],
];

export const TEMPLATE_NAME = "arcface-112";

/** Five points of the template, in pixels of a crop whose side is a multiple of 112 or of 128. */
export function template(size: number): Point[] {
  const [ratio, move] = size % 112 === 0 ? [size / 112, 0] : [size / 128, (8 * size) / 128];
  if (size <= 0 || (size % 112 !== 0 && size % 128 !== 0)) {
    throw unusable(`there is no common alignment template for a ${size} x ${size} embedder`);
  }
  return TEMPLATE_112.map(([x, y]) => [x * ratio + move, y * ratio]);
}

/**
 * Least-squares similarity: rotation, uniform scale, translation; no shear, no mirror.
 *
 * With points as complex numbers it is the regression `w = a z + b` (S. Umeyama, IEEE TPAMI 13(4),
 * 1991). Throws `RangeError` where the source points are not finite, or all equal.
 */
export function similarityTransform(source: readonly Point[], target: readonly Point[]): Affine {
  const mean = (points: readonly Point[], axis: 0 | 1): number =>
    points.reduce((sum, point) => sum + point[axis], 0) / points.length;
  const [zx, zy, wx, wy] = [mean(source, 0), mean(source, 1), mean(target, 0), mean(target, 1)];
  let [power, real, imaginary] = [0, 0, 0];
  source.forEach(([x, y], i) => {
    const [dx, dy] = [x - zx, y - zy];
    const [u, v] = [target[i][0] - wx, target[i][1] - wy];
    power += dx * dx + dy * dy;
    real += dx * u + dy * v;
    imaginary += dx * v - dy * u;
  });
  if (!Number.isFinite(power) || power <= 0) {
    throw new RangeError("the source points must be finite and not all equal");
  }
  const [a, b] = [real / power, imaginary / power];
  return [a, -b, wx - a * zx + b * zy, b, a, wy - b * zx - a * zy];
}

/** Crop a face so that its five points lie on the template of a `size` x `size` crop. */
export function align(image: RgbImage, keypoints: readonly Point[], size: number): RgbImage {
  return warpAffine(image, similarityTransform(keypoints, template(size)), size);
}
