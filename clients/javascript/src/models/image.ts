/** Pictures as arrays, and the three ways in which they are resampled, as OpenCV does it. */

import { ImageError } from "./errors.js";

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
  const count = pixels.width * pixels.height;
  const data = new Uint8Array(3 * count);
  for (let from = 0, to = 0; to < data.length; from += 4, to += 3) {
    data[to] = pixels.data[from];
    data[to + 1] = pixels.data[from + 1];
    data[to + 2] = pixels.data[from + 2];
  }
  return rgbImage(data, pixels.width, pixels.height);
}

/**
 * Decode a photo in a browser, upright: the EXIF orientation is applied.
 *
 * Colours stay as they are in the file, as the service reads them. Throws `ImageError` of a
 * file that is no picture.
 */
export async function decodeImage(photo: Blob): Promise<RgbImage> {
  const bitmap = await createImageBitmap(photo, {
    imageOrientation: "from-image",
    colorSpaceConversion: "none",
  }).catch(() => {
    throw new ImageError();
  });
  try {
    const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
    const context = canvas.getContext("2d", { willReadFrequently: true });
    if (context === null) throw new Error("this browser gives no canvas to decode with");
    context.drawImage(bitmap, 0, 0);
    return fromImageData(context.getImageData(0, 0, bitmap.width, bitmap.height));
  } finally {
    bitmap.close();
  }
}

// OpenCV's bilinear weights are whole multiples of 1/2048.
const WEIGHT_BITS = 11;

interface Taps {
  readonly first: Int32Array;
  readonly second: Int32Array;
  readonly weights: Int32Array;
}

function linearTaps(from: number, to: number): Taps {
  const first = new Int32Array(to);
  const second = new Int32Array(to);
  const weights = new Int32Array(2 * to);
  const scale = from / to;
  for (let i = 0; i < to; i++) {
    const at = Math.fround((i + 0.5) * scale - 0.5);
    let low = Math.floor(at);
    let share = Math.fround(at - low);
    if (low < 0) [low, share] = [0, 0];
    if (low >= from - 1) [low, share] = [from - 1, 0];
    first[i] = low;
    second[i] = Math.min(low + 1, from - 1);
    weights[2 * i] = roundHalfEven(Math.fround(1 - share) * (1 << WEIGHT_BITS));
    weights[2 * i + 1] = roundHalfEven(share * (1 << WEIGHT_BITS));
  }
  return { first, second, weights };
}

/** Resize bilinearly, in the fixed-point arithmetic of `cv2.resize` with `INTER_LINEAR`. */
export function resizeLinear(image: RgbImage, width: number, height: number): RgbImage {
  if (width === image.width && height === image.height) return image;
  // OpenCV halves by areas.
  if (2 * width === image.width && 2 * height === image.height) {
    return resizeArea(image, width, height);
  }
  const columns = linearTaps(image.width, width);
  const rows = linearTaps(image.height, height);
  const out = new Uint8Array(3 * width * height);
  // Rows of the source, resized along x and kept for the next row of the result.
  const kept = [new Int32Array(3 * width), new Int32Array(3 * width)];
  const keptAt = [-1, -1];
  const resized = (row: number, other: number): Int32Array => {
    const known = keptAt.indexOf(row);
    if (known >= 0) return kept[known];
    const place = keptAt[0] === other ? 1 : 0;
    const line = kept[place];
    const start = 3 * row * image.width;
    for (let x = 0; x < width; x++) {
      const a = start + 3 * columns.first[x];
      const b = start + 3 * columns.second[x];
      const left = columns.weights[2 * x];
      const right = columns.weights[2 * x + 1];
      for (let c = 0; c < 3; c++) {
        line[3 * x + c] = image.data[a + c] * left + image.data[b + c] * right;
      }
    }
    keptAt[place] = row;
    return line;
  };
  for (let y = 0; y < height; y++) {
    const above = resized(rows.first[y], rows.second[y]);
    const below = resized(rows.second[y], rows.first[y]);
    const upper = rows.weights[2 * y];
    const lower = rows.weights[2 * y + 1];
    const start = 3 * y * width;
    for (let i = 0; i < above.length; i++) {
      const sum = ((upper * (above[i] >> 4)) >> 16) + ((lower * (below[i] >> 4)) >> 16);
      out[start + i] = (sum + 2) >> 2;
    }
  }
  return { data: out, width, height };
}

/** Share that each source pixel has in the result: runs of weights, one after the other. */
function areaTaps(from: number, to: number): { start: Int32Array; weights: number[][] } {
  const start = new Int32Array(to);
  const weights: number[][] = [];
  const scale = from / to;
  for (let i = 0; i < to; i++) {
    const [low, high] = [i * scale, Math.min((i + 1) * scale, from)];
    start[i] = Math.floor(low);
    const run: number[] = [];
    for (let j = start[i]; j < high && j < from; j++) {
      run.push(Math.min(high, j + 1) - Math.max(low, j));
    }
    const total = run.reduce((sum, share) => sum + share, 0);
    weights.push(run.map((share) => share / total));
  }
  return { start, weights };
}

/** Shrink to the mean of the area that each pixel covers, as `cv2.resize` with `INTER_AREA`. */
export function resizeArea(image: RgbImage, width: number, height: number): RgbImage {
  if (width === image.width && height === image.height) return image;
  const columns = areaTaps(image.width, width);
  const rows = areaTaps(image.height, height);
  const out = new Uint8Array(3 * width * height);
  const sums = new Float64Array(3 * image.width);
  for (let y = 0; y < height; y++) {
    sums.fill(0);
    rows.weights[y].forEach((share, j) => {
      const start = 3 * (rows.start[y] + j) * image.width;
      for (let i = 0; i < sums.length; i++) sums[i] += share * image.data[start + i];
    });
    for (let x = 0; x < width; x++) {
      for (let c = 0; c < 3; c++) {
        let sum = 0;
        columns.weights[x].forEach((share, j) => {
          sum += share * sums[3 * (columns.start[x] + j) + c];
        });
        // The sum of shares may miss a half by an ulp; OpenCV adds whole numbers.
        out[3 * (y * width + x) + c] = Math.floor(sum + 0.5 + 1e-9);
      }
    }
  }
  return { data: out, width, height };
}

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
        out[3 * (v * size + u) + k] = roundHalfEven(above * (1 - fy) + below * fy);
      }
    }
  }
  return { data: out, width: size, height: size };
}

/** Put a picture into a black one, `top` and `left` pixels from its corner. */
export function placed(
  image: RgbImage,
  width: number,
  height: number,
  top = 0,
  left = 0,
): RgbImage {
  const data = new Uint8Array(3 * width * height);
  for (let y = 0; y < image.height; y++) {
    const row = image.data.subarray(3 * y * image.width, 3 * (y + 1) * image.width);
    data.set(row, 3 * ((y + top) * width + left));
  }
  return { data, width, height };
}

/** Round to the nearest whole number, halves to the even one, as Python and OpenCV do. */
export function roundHalfEven(value: number): number {
  const low = Math.floor(value);
  const share = value - low;
  if (share !== 0.5) return share < 0.5 ? low : low + 1;
  return low % 2 === 0 ? low : low + 1;
}
