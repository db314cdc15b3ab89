/** Is this face good enough to enroll or to verify? Measures, limits, and named refusals. */

import { similarityTransform, template } from "./alignment.js";
import { boxHeight, boxWidth, shorterSide, type Face, type Point } from "./boxes.js";
import { FaceTooSmall, LowQuality, type Measured } from "./errors.js";
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

/** What was measured on one face; null for crops that came aligned. */
export interface Quality {
  /** Confidence of the detector, 0…1. */
  readonly score: number | null;
  /** Shorter side of the detected box in pixels. */
  readonly face_size: number | null;
  /** Fine detail of the aligned crop: about 3 for a sharp photo, below 0.5 for a useless one. */
  readonly sharpness: number;
  /** Mean luma of the centre of the aligned crop, 0…255. */
  readonly brightness: number;
  /** Luma that a twentieth of the whole picture exceeds, 0…255. */
  readonly exposure: number;
  /** Degrees. */
  readonly yaw: number | null;
  readonly pitch: number | null;
  readonly roll: number | null;
  /** Least distance of the five points from the picture's border, over the aligned crop's side. */
  readonly border: number | null;
  /** Height of the detected box over its width. */
  readonly aspect: number | null;
}

/** What a face must reach: the names are those of {@link Quality}. */
export interface QualityLimits {
  /** Undefined takes the detector's own recommendation. */
  readonly min_score?: number;
  readonly min_face_size: number;
  readonly min_sharpness: number;
  readonly min_brightness: number;
  readonly max_brightness: number;
  readonly min_exposure: number;
  readonly max_yaw: number;
  readonly max_pitch: number;
  readonly max_roll: number;
  readonly min_border: number;
  readonly max_aspect: number;
}

export const DEFAULT_QUALITY: QualityLimits = {
  min_face_size: 24,
  min_sharpness: 0.5,
  min_brightness: 6,
  max_brightness: 235,
  min_exposure: 40,
  max_yaw: 70,
  max_pitch: 55,
  max_roll: 45,
  min_border: 0.08,
  max_aspect: 1.7,
};

/** Measure the aligned crop of a face in `image`; `face` is undefined for crops that came aligned. */
export function measure(crop: RgbImage, face: Face | undefined, image: RgbImage): Quality {
  const grey = greyCrop(crop);
  let brightness = 0;
  for (let y = MARGIN; y < SIDE - MARGIN; y++) {
    for (let x = MARGIN; x < SIDE - MARGIN; x++) brightness += grey[y * SIDE + x];
  }
  const pose = face === undefined ? undefined : measurePose(face.keypoints);
  return {
    score: face?.score ?? null,
    face_size: face === undefined ? null : shorterSide(face),
    sharpness: measureSharpness(grey),
    brightness: brightness / (SIDE - 2 * MARGIN) ** 2,
    exposure: measureExposure(image),
    yaw: pose?.yaw ?? null,
    pitch: pose?.pitch ?? null,
    roll: pose?.roll ?? null,
    border: face === undefined ? null : measureBorder(face.keypoints, image),
    aspect: face === undefined ? null : boxHeight(face.box) / boxWidth(face.box),
  };
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
  const grey = new Uint8Array(crop.width * crop.height);
  for (let i = 0; i < grey.length; i++) {
    grey[i] = luma(crop.data, 3 * i);
  }
  if (crop.width === SIDE) return Float64Array.from(grey);
  const tripled = new Uint8Array(3 * grey.length).map((_, i) => grey[Math.floor(i / 3)]);
  const small = resizeArea({ ...crop, data: tripled }, SIDE, SIDE);
  return Float64Array.from({ length: SIDE * SIDE }, (_, i) => small.data[3 * i]);
}

/**
 * Fine detail in the direction that has least of it: second differences of the smoothed picture,
 * the least mean square of four directions over the variance, times 1000.
 */
export function measureSharpness(grey: Float64Array): number {
  const smooth = blurred(grey);
  const inner = SIDE - 2 * MARGIN;
  const count = inner * inner;
  const mean = (of: (at: number) => number): number => {
    let sum = 0;
    for (let y = MARGIN; y < SIDE - MARGIN; y++) {
      for (let x = MARGIN; x < SIDE - MARGIN; x++) sum += of(y * SIDE + x);
    }
    return sum / count;
  };
  const level = mean((at) => smooth[at]);
  const variance = mean((at) => (smooth[at] - level) ** 2);
  if (variance < 1e-6) return 0;
  // Diagonal neighbours are sqrt(2) apart, which doubles a second difference.
  const directions = [
    [1, 1],
    [SIDE, 1],
    [SIDE + 1, 0.5],
    [SIDE - 1, 0.5],
  ];
  const energies = directions.map(([step, weight]) =>
    mean((at) => ((smooth[at - step] - 2 * smooth[at] + smooth[at + step]) * weight) ** 2),
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
export function measurePose(keypoints: readonly Point[]): {
  yaw: number;
  pitch: number;
  roll: number;
} {
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

const REMEDIES: Readonly<Record<string, string>> = {
  score: "Show the face unobstructed.",
  blur: "Hold the camera still and focus on the face.",
  darkness: "Put more light on the face.",
  brightness: "Put less light on the face.",
  turned: "Hold the photo upright.",
  pose: "Look into the camera.",
  hidden: "Show the whole face, with nothing before it and some room around it.",
};

/**
 * Refuse a face that fails a limit, by `FaceTooSmall` or by `LowQuality`, which names every one.
 *
 * @param recommendedScore what `min_score` is where the limits leave it open.
 */
export function check(quality: Quality, limits: QualityLimits, recommendedScore: number): void {
  const size = quality.face_size;
  if (size !== null && size < limits.min_face_size) {
    throw new FaceTooSmall(
      `The face is ${size.toFixed(0)} pixels wide; at least ${limits.min_face_size} are needed. ` +
        "Come closer or send a larger photo.",
      { size: measured(size, limits.min_face_size) },
    );
  }
  const minScore = limits.min_score ?? recommendedScore;
  const failed: Record<string, Measured | Record<string, Measured>> = {};
  if (quality.score !== null && quality.score < minScore) {
    failed["score"] = measured(quality.score, minScore);
  }
  if (quality.sharpness < limits.min_sharpness) {
    failed["blur"] = measured(quality.sharpness, limits.min_sharpness);
  }
  if (quality.exposure < limits.min_exposure) {
    failed["darkness"] = measured(quality.exposure, limits.min_exposure);
  } else if (quality.brightness < limits.min_brightness) {
    failed["darkness"] = measured(quality.brightness, limits.min_brightness);
  }
  if (quality.brightness > limits.max_brightness) {
    failed["brightness"] = measured(quality.brightness, limits.max_brightness);
  }
  if (quality.roll !== null && Math.abs(quality.roll) > limits.max_roll) {
    failed["turned"] = measured(quality.roll, limits.max_roll);
  }
  const pose: Record<string, Measured> = {};
  for (const name of ["yaw", "pitch"] as const) {
    const angle = quality[name];
    const limit = limits[`max_${name}`];
    if (angle !== null && Math.abs(angle) > limit) pose[name] = measured(angle, limit);
  }
  if (Object.keys(pose).length > 0) failed["pose"] = pose;
  const hidden: Record<string, Measured> = {};
  if (quality.border !== null && quality.border < limits.min_border) {
    hidden["border"] = measured(quality.border, limits.min_border);
  }
  if (quality.aspect !== null && quality.aspect > limits.max_aspect) {
    hidden["aspect"] = measured(quality.aspect, limits.max_aspect);
  }
  if (Object.keys(hidden).length > 0) failed["hidden"] = hidden;
  const names = Object.keys(failed);
  if (names.length > 0) {
    const remedies = names.map((name) => REMEDIES[name]).join(" ");
    throw new LowQuality(`The photo is not good enough (${names.join(", ")}). ${remedies}`, failed);
  }
}

const measured = (value: number, limit: number): Measured => ({
  value: Math.round(value * 1000) / 1000,
  limit,
});
