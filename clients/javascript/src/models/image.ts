/** Pictures as arrays, and the three ways in which they are resampled, as OpenCV does it. */

import { VeilfaceError } from "../errors.js";

/** A picture: RGB, 8 bits a channel, row by row from the top. */
export interface RgbImage {
  readonly width: number;
  readonly height: number;
  /** `3 * width * height` values. */
  readonly data: Uint8Array;
}

/** Two rows of three numbers: `[a, b, x, c, d, y]` takes (u, v) to (a u + b v + x, c u + d v + y). */
export type Affine = readonly [number, number, number, number, number, number];

/** Make a picture of RGB values; throws `RangeError` where their number does not fit. */
export function rgbImage(data: Uint8Array, width: number, height: number): RgbImage {
  if (!(width >= 1 && height >= 1) || data.length !== 3 * width * height) {
    throw new RangeError(`a picture of ${width} x ${height} has 3 values for each of its pixels`);
  }
  return { data, width, height };
}

/** Drop the alpha channel of what a canvas gives. */
export function fromImageData(pixels: {
  readonly data: ArrayLike<number>;
  readonly width: number;
  readonly height: number;
}): RgbImage {
  const { data, width, height } = pixels;
  const rgb = new Uint8Array(3 * width * height);
  for (let i = 0; i < rgb.length; i++) rgb[i] = data[i + Math.floor(i / 3)];
  return rgbImage(rgb, width, height);
}

/**
 * Decode a photo in a browser, upright: the EXIF orientation is applied.
 *
 * Colours stay as they are in the file, as the service reads them. Throws
 * `unsupported_image` of a file that is no picture.
 */
export async function decodeImage(photo: Blob): Promise<RgbImage> {
  const bitmap = await createImageBitmap(photo, {
    imageOrientation: "from-image",
    colorSpaceConversion: "none",
  }).catch(() => {
    const message = "The file is not a picture that this browser reads; send a JPEG or PNG.";
    throw new VeilfaceError("unsupported_image", message);
  });
  try {
    return drawn(bitmap, bitmap.width, bitmap.height);
  } finally {
    bitmap.close();
  }
}

/** What a canvas shows of a picture, or of a video now. */
export function drawn(source: ImageBitmap | HTMLVideoElement, width: number, height: number): RgbImage {
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  if (context === null) throw new Error("this browser gives no canvas to read a picture with");
  context.drawImage(source, 0, 0);
  return fromImageData(context.getImageData(0, 0, width, height));
}

/** What one pixel of the result takes along one side: weights of pixels from `start` on. */
interface Taps {
  readonly start: number;
  readonly weights: readonly number[];
}

/** The two nearest pixels, by the distance of their centres. */
function linearTaps(from: number, to: number): Taps[] {
  return Array.from({ length: to }, (_, i) => {
    const at = ((i + 0.5) * from) / to - 0.5;
    const start = Math.floor(at);
    if (start < 0) return { start: 0, weights: [1] };
    if (start >= from - 1) return { start: from - 1, weights: [1] };
    return { start, weights: [start + 1 - at, at - start] };
  });
}

/** All pixels that the pixel of the result covers, by the share of it that each has. */
function areaTaps(from: number, to: number): Taps[] {
  const scale = from / to;
  return Array.from({ length: to }, (_, i) => {
    const [low, high] = [i * scale, Math.min((i + 1) * scale, from)];
    const start = Math.floor(low);
    const weights: number[] = [];
    for (let j = start; j < high; j++) {
      weights.push((Math.min(high, j + 1) - Math.max(low, j)) / (high - low));
    }
    return { start, weights };
  });
}

function resize(image: RgbImage, width: number, height: number, taps: typeof linearTaps, rounding: number): RgbImage {
  if (width === image.width && height === image.height) return image;
  const columns = taps(image.width, width);
  const data = new Uint8Array(3 * width * height);
  const line = new Float64Array(3 * image.width);
  taps(image.height, height).forEach(({ start: top, weights }, y) => {
    line.fill(0);
    weights.forEach((weight, j) => {
      const row = image.data.subarray(3 * (top + j) * image.width);
      for (let i = 0; i < line.length; i++) line[i] += weight * row[i];
    });
    columns.forEach(({ start: left, weights: shares }, x) => {
      for (let channel = 0; channel < 3; channel++) {
        let sum = 0;
        for (let j = 0; j < shares.length; j++) sum += shares[j] * line[3 * (left + j) + channel];
        // Sums of shares may miss a half by an ulp; OpenCV adds whole numbers.
        data[3 * (y * width + x) + channel] = Math.floor(sum + rounding + 1e-9);
      }
    });
  });
  return { data, width, height };
}

/** Resize bilinearly, as `cv2.resize` with `INTER_LINEAR`. */
export const resizeLinear = (image: RgbImage, width: number, height: number): RgbImage => {
  // OpenCV halves by areas. Else its fixed point cuts two summands to quarters, which loses a quarter
  // on average, and rounds their sum half up, which gains an eighth.
  const isHalf = 2 * width === image.width && 2 * height === image.height;
  return isHalf ? resizeArea(image, width, height) : resize(image, width, height, linearTaps, 0.375);
};

/** Shrink to the mean of the area that each pixel covers, as `cv2.resize` with `INTER_AREA`. */
export const resizeArea = (image: RgbImage, width: number, height: number): RgbImage =>
  resize(image, width, height, areaTaps, 0.5);

/**
 * Warp bilinearly into a square, 0 outside of the picture, as `cv2.warpAffine`.
 *
 * @param matrix takes pixels of `image` to pixels of the result.
 * @param size side of the result.
 */
export function warpAffine(image: RgbImage, matrix: Affine, size: number): RgbImage {
  const [a, b, x0, c, d, y0] = matrix;
  const det = a * d - b * c;
  const [ia, ib, ic, id] = [d / det, -b / det, -c / det, a / det];
  const [ix, iy] = [-(ia * x0 + ib * y0), -(ic * x0 + id * y0)];
  const { width, height, data } = image;
  const out = new Uint8Array(3 * size * size);
  const value = (column: number, row: number, channel: number): number =>
    column < 0 || row < 0 || column >= width || row >= height
      ? 0
      : data[3 * (row * width + column) + channel];
  for (let v = 0; v < size; v++) {
    for (let u = 0; u < size; u++) {
      const x = ia * u + ib * v + ix;
      const y = ic * u + id * v + iy;
      const [left, top] = [Math.floor(x), Math.floor(y)];
      const [fx, fy] = [x - left, y - top];
      for (let k = 0; k < 3; k++) {
        const above = value(left, top, k) * (1 - fx) + value(left + 1, top, k) * fx;
        const below = value(left, top + 1, k) * (1 - fx) + value(left + 1, top + 1, k) * fx;
        out[3 * (v * size + u) + k] = Math.round(above * (1 - fy) + below * fy);
      }
    }
  }
  return { data: out, width: size, height: size };
}

/** Put a picture into a black one, `top` and `left` pixels from its corner. */
export function placed(image: RgbImage, width: number, height: number, top = 0, left = 0): RgbImage {
  const data = new Uint8Array(3 * width * height);
  for (let y = 0; y < image.height; y++) {
    const row = image.data.subarray(3 * y * image.width, 3 * (y + 1) * image.width);
    data.set(row, 3 * ((y + top) * width + left));
  }
  return { data, width, height };
}

/** Round to the nearest whole number, halves to the even one, as Python does sizes. */
export function roundHalfEven(value: number): number {
  const low = Math.floor(value);
  return value - low === 0.5 ? low + Math.abs(low % 2) : Math.round(value);
}
