/** Is this face good enough to enroll or to verify? Measures, limits, and named refusals. */

import { VeilfaceError } from "../errors.js";
import { similarityTransform, template } from "./alignment.js";
import { boxHeight, boxWidth, shorterSide, type Face, type Point } from "./faces.js";
import { resizeArea, type RgbImage } from "./image.js";

// As in `models/quality.py`, where the reason for each number stands.
const SIDE = 112;
const MARGIN = 20;
const SMOOTHING = 1.5;
const SMOOTHING_RADIUS = 6;
const EXPOSURE_SIDE = 256;
const EYES_PER_NOSE = 1.41;
const HEIGHT_PER_NOSE = 3.26;
const NEUTRAL_NOSE = 0.545;

/** What a face must reach, by what is measured. */
export const QUALITY_LIMITS = {
  face_size: 24,
  sharpness: 0.5,
  brightness: [6, 235],
  exposure: 40,
  yaw: 70,
  pitch: 55,
  roll: 45,
  border: 0.08,
  aspect: 1.7,
} as const;

/** What was measured on one face; what is of the detected face is null for crops that came aligned. */
export type Quality = ReturnType<typeof measure>;

/** Measure the aligned crop of a face in `image`; `face` is undefined for crops that came aligned. */
export function measure(crop: RgbImage, face: Face | undefined, image: RgbImage) {
  const grey = greyCrop(crop);
  const pose = face && measurePose(face.keypoints);
  return {
    /** Confidence of the detector, 0…1. */
    score: face?.score ?? null,
    /** Shorter side of the detected box in pixels. */
    face_size: face ? shorterSide(face) : null,
    /** Fine detail of the aligned crop: about 3 for a sharp photo, below 0.5 for a useless one. */
    sharpness: measureSharpness(grey),
    /** Mean luma of the centre of the aligned crop, 0…255. */
    brightness: meanOfCentre((at) => grey[at]),
    /** Luma that a twentieth of the whole picture exceeds, 0…255. */
    exposure: measureExposure(image),
    /** Degrees. */
    yaw: pose?.yaw ?? null,
    pitch: pose?.pitch ?? null,
    roll: pose?.roll ?? null,
    /** Least distance of the five points from the picture's border, over the aligned crop's side. */
    border: face ? measureBorder(face.keypoints, image) : null,
    /** Height of the detected box over its width. */
    aspect: face ? boxHeight(face.box) / boxWidth(face.box) : null,
  };
}

/** Mean over the pixels of the crop's centre. */
function meanOfCentre(of: (at: number) => number): number {
  let sum = 0;
  for (let y = MARGIN; y < SIDE - MARGIN; y++) {
    for (let x = MARGIN; x < SIDE - MARGIN; x++) sum += of(y * SIDE + x);
  }
  return sum / (SIDE - 2 * MARGIN) ** 2;
}

function measureExposure({ data, width, height }: RgbImage): number {
  const step = Math.max(1, Math.floor(Math.max(width, height) / EXPOSURE_SIDE));
  const lumas: number[] = [];
  for (let y = 0; y < height; y += step) {
    for (let x = 0; x < width; x += step) lumas.push(luma(data, 3 * (y * width + x)));
  }
  lumas.sort((a, b) => a - b);
  return lumas[Math.floor(0.95 * (lumas.length - 1))];
}

/** Luma of a pixel in OpenCV's fixed point. */
const luma = (data: Uint8Array, at: number): number =>
  (data[at] * 9798 + data[at + 1] * 19235 + data[at + 2] * 3735 + (1 << 14)) >> 15;

function measureBorder(keypoints: readonly Point[], image: RgbImage): number {
  const [a, b] = similarityTransform(keypoints, template(SIDE));
  const distances = keypoints.flatMap(([x, y]) => [x, y, image.width - 1 - x, image.height - 1 - y]);
  return (Math.min(...distances) * Math.hypot(a, b)) / SIDE;
}

/** Luma, 112 x 112. */
function greyCrop(crop: RgbImage): Float64Array {
  const { data } = resizeArea(crop, SIDE, SIDE);
  return Float64Array.from({ length: SIDE * SIDE }, (_, i) => luma(data, 3 * i));
}

/**
 * Fine detail in the direction that has least of it: second differences of the smoothed picture,
 * the least mean square of four directions over the variance, times 1000.
 */
export function measureSharpness(grey: Float64Array): number {
  const smooth = blurred(grey);
  const level = meanOfCentre((at) => smooth[at]);
  const variance = meanOfCentre((at) => (smooth[at] - level) ** 2);
  if (variance < 1e-6) return 0;
  // Diagonal neighbours are sqrt(2) apart, which doubles a second difference.
  const directions = [[1, 1], [SIDE, 1], [SIDE + 1, 0.5], [SIDE - 1, 0.5]];
  const energies = directions.map(([step, weight]) =>
    meanOfCentre((at) => ((smooth[at - step] - 2 * smooth[at] + smooth[at + step]) * weight) ** 2),
  );
  return (1000 * Math.min(...energies)) / variance;
}

/** Gaussian blur, mirrored at the border without repeating it, as `cv2.GaussianBlur`. */
function blurred(grey: Float64Array): Float64Array {
  const offsets = Array.from({ length: 2 * SMOOTHING_RADIUS + 1 }, (_, i) => i - SMOOTHING_RADIUS);
  const weights = offsets.map((offset) => Math.exp(-(offset ** 2) / (2 * SMOOTHING ** 2)));
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  const inside = (i: number): number => (i < 0 ? -i : i >= SIDE ? 2 * SIDE - 2 - i : i);
  const along = (from: Float64Array, at: (line: number, i: number) => number): Float64Array => {
    const to = new Float64Array(SIDE * SIDE);
    for (let line = 0; line < SIDE; line++) {
      for (let i = 0; i < SIDE; i++) {
        let sum = 0;
        offsets.forEach((offset, k) => (sum += weights[k] * from[at(line, inside(i + offset))]));
        to[at(line, i)] = sum / total;
      }
    }
    return to;
  };
  const rows = along(grey, (line, i) => line * SIDE + i);
  return along(rows, (line, i) => i * SIDE + line);
}

/** Yaw, pitch and roll of a face from its five points, in degrees; good to about 10. */
export function measurePose(keypoints: readonly Point[]): { yaw: number; pitch: number; roll: number } {
  const [a, b, x0, c, d, y0] = similarityTransform(keypoints, template(SIDE));
  const [left, right, nose, mouthLeft, mouthRight] = keypoints.map(([x, y]): Point => [
    a * x + b * y + x0,
    c * x + d * y + y0,
  ]);
  const middle = (p: Point, q: Point): Point => [(p[0] + q[0]) / 2, (p[1] + q[1]) / 2];
  const [eyes, mouth] = [middle(left, right), middle(mouthLeft, mouthRight)];
  const axis = [mouth[0] - eyes[0], mouth[1] - eyes[1]];
  const out = [nose[0] - eyes[0], nose[1] - eyes[1]];
  const height = Math.hypot(...axis) || 1e-9;
  const along = (out[0] * axis[0] + out[1] * axis[1]) / height ** 2;
  const across = (axis[1] * out[0] - axis[0] * out[1]) / height;
  const halfEyes = Math.hypot(right[0] - left[0], right[1] - left[1]) / 2 || 1e-9;
  const degrees = (radians: number): number => (radians * 180) / Math.PI;
  return {
    yaw: degrees(Math.atan((EYES_PER_NOSE * across) / halfEyes)),
    pitch: degrees(Math.atan(HEIGHT_PER_NOSE * (along - NEUTRAL_NOSE))),
    roll: degrees(Math.atan2(-c, a)),
  };
}

/**
 * Refuse a face that fails a limit, by `face_too_small` or by `low_quality`, which names every one.
 *
 * @param leastScore confidence that the detector recommends.
 */
export function requireQuality(quality: Quality, leastScore: number): void {
  const limits = QUALITY_LIMITS;
  const size = quality.face_size;
  if (size !== null && size < limits.face_size) {
    throw new VeilfaceError(
      "face_too_small",
      `The face is ${size.toFixed(0)} pixels wide; at least ${limits.face_size} are needed.`,
      { details: { size: measured(size, limits.face_size) } },
    );
  }
  const { score, sharpness, brightness, exposure, yaw, pitch, roll, border, aspect } = quality;
  const below = (value: number | null, limit: number): boolean => value !== null && value < limit;
  const beyond = (value: number | null, limit: number): boolean => value !== null && Math.abs(value) > limit;
  const [darkest, brightest] = limits.brightness;
  const checks: readonly [string, string | null, number | null, number, boolean][] = [
    ["score", null, score, leastScore, below(score, leastScore)],
    ["blur", null, sharpness, limits.sharpness, below(sharpness, limits.sharpness)],
    ["darkness", null, exposure, limits.exposure, below(exposure, limits.exposure)],
    ["darkness", null, brightness, darkest, below(brightness, darkest)],
    ["brightness", null, brightness, brightest, beyond(brightness, brightest)],
    ["turned", null, roll, limits.roll, beyond(roll, limits.roll)],
    ["pose", "yaw", yaw, limits.yaw, beyond(yaw, limits.yaw)],
    ["pose", "pitch", pitch, limits.pitch, beyond(pitch, limits.pitch)],
    ["hidden", "border", border, limits.border, below(border, limits.border)],
    ["hidden", "aspect", aspect, limits.aspect, beyond(aspect, limits.aspect)],
  ];
  const failed: Record<string, object> = {};
  for (const [what, part, value, limit, fails] of checks) {
    if (!fails) continue;
    const seen = measured(value ?? 0, limit);
    if (part !== null) failed[what] = { ...failed[what], [part]: seen };
    else failed[what] ??= seen;
  }
  const names = Object.keys(failed);
  if (names.length === 0) return;
  throw new VeilfaceError("low_quality", `The photo is not good enough (${names.join(", ")}).`, { details: failed });
}

const measured = (value: number, limit: number): { value: number; limit: number } => ({
  value: Math.round(value * 1000) / 1000,
  limit,
});
