/** Several photos of one person: how well they agree that they are, and the one mean of them. */

import { InconsistentImages } from "./errors.js";

const LEAST_NORM = 1e-12;
const LEAST_MEAN = 1e-6;

/**
 * Average the unit embeddings of one person and normalise; one that comes again counts once.
 *
 * @param consistency the contract's limit of how well the photos must agree.
 * @throws InconsistentImages where they part into two groups that agree less, or cancel.
 */
export function meanEmbedding(
  embeddings: readonly Float32Array[],
  consistency: number,
): Float32Array {
  const same = (one: Float32Array) => (other: Float32Array) => one.every((x, i) => x === other[i]);
  const places = embeddings.flatMap((row, i) => (embeddings.findIndex(same(row)) === i ? [i] : []));
  const rows = places.map((i) => embeddings[i]);
  const mean = new Float64Array(rows[0].length);
  for (const row of rows) row.forEach((value, i) => (mean[i] += value / rows.length));
  const norm = Math.sqrt(mean.reduce((sum, value) => sum + value * value, 0));
  if (rows.length > 1) {
    const { agreement, apart, others } = weakestSplit(rows);
    if (agreement < consistency || norm < LEAST_MEAN) {
      throw new InconsistentImages(apart.map((i) => places[i]), others.map((i) => places[i]));
    }
  }
  return Float32Array.from(mean, (value) => value / norm);
}

/** The way to part photos into two groups that speaks most for two people. */
export interface WeakestSplit {
  /** How alike the two groups are, -1 to 1. */
  readonly agreement: number;
  /** Positions of the smaller group; of equal ones that without the first photo. */
  readonly apart: readonly number[];
  readonly others: readonly number[];
}

/**
 * Find the split of 2 to 10 photos into two groups that agree least.
 *
 * One photo agrees with the others by its cosine to their mean, larger groups by the mean cosine
 * across (docs/thresholds.md "Photos of one person").
 */
export function weakestSplit(embeddings: readonly Float32Array[]): WeakestSplit {
  const count = embeddings.length;
  const cosines = embeddings.map((one) =>
    embeddings.map((other) => one.reduce((sum, value, i) => sum + value * other[i], 0)),
  );
  const between = (first: readonly number[], second: readonly number[]): number =>
    first.reduce((sum, i) => second.reduce((total, j) => total + cosines[i][j], sum), 0);
  let weakest: WeakestSplit | undefined;
  // The first photo is on the side of zeros, so that every split occurs once.
  for (let split = 1; split < 2 ** (count - 1); split++) {
    const positions = embeddings.map((_, i) => i);
    const ones = positions.filter((i) => i > 0 && (split >> (i - 1)) & 1);
    const zeros = positions.filter((i) => !ones.includes(i));
    const across = between(ones, zeros);
    const single = Math.min(ones.length, zeros.length) === 1;
    const agreement = single
      ? across / Math.sqrt(Math.max(between(ones, ones) * between(zeros, zeros), LEAST_NORM))
      : across / (ones.length * zeros.length);
    if (weakest === undefined || agreement < weakest.agreement) {
      const [apart, others] = ones.length <= zeros.length ? [ones, zeros] : [zeros, ones];
      weakest = { agreement, apart, others };
    }
  }
  if (weakest === undefined) throw new RangeError("one photo agrees with itself: a split needs two");
  return weakest;
}
