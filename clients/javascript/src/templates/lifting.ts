/** From embeddings to private templates: `templates/space/agreement.py` and `lifting.py`. */

import { ContractError, PhotoError } from "../errors.js";
import type { DecoyGenerator } from "./generator.js";
import { uniform } from "./samples.js";
import { dot, rowsOf, templateThrough, type AffineSubspace } from "./subspace.js";

/** The strategies that a decoy generator serves. */
export type Strategy = "random" | "adversarial" | "hybrid";

const LEAST_NORM = 1e-12;
const LEAST_MEAN = 1e-6;
// Two decoys, or a decoy and the point, nearer than this would add a direction of noise.
const SAME = 1e-3;
const REDRAWS = 16;

/**
 * Average the unit embeddings of one person and normalise; one that comes again counts once.
 *
 * @param consistency the contract's limit of how well the photos must agree.
 * @throws PhotoError `inconsistent_images`, where they part into two groups that agree less, or cancel.
 */
export function meanEmbedding(embeddings: readonly Float32Array[], consistency: number): Float32Array {
  const same = (one: Float32Array) => (other: Float32Array) => one.every((x, i) => x === other[i]);
  const places = embeddings.flatMap((row, i) => (embeddings.findIndex(same(row)) === i ? [i] : []));
  const rows = places.map((i) => Float64Array.from(embeddings[i]));
  const mean = new Float64Array(rows[0].length);
  for (const row of rows) row.forEach((value, i) => (mean[i] += value / rows.length));
  const norm = Math.sqrt(dot(mean, mean));
  if (rows.length > 1) {
    const { agreement, apart, others } = weakestSplit(rows);
    if (agreement < consistency || norm < LEAST_MEAN) {
      throw inconsistent(apart.map((i) => places[i]), others.map((i) => places[i]));
    }
  }
  return Float32Array.from(mean, (value) => value / norm);
}

interface Split {
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
function weakestSplit(rows: readonly Float64Array[]): Split {
  const cosines = rows.map((one) => rows.map((other) => dot(one, other)));
  const between = (first: readonly number[], second: readonly number[]): number =>
    first.reduce((sum, i) => second.reduce((total, j) => total + cosines[i][j], sum), 0);
  let weakest: Split = { agreement: Infinity, apart: [], others: [] };
  // The first photo is on the side of zeros, so that every split occurs once.
  for (let split = 2; split < 2 ** rows.length; split += 2) {
    const positions = rows.map((_, i) => i);
    const ones = positions.filter((i) => (split >> i) & 1);
    const zeros = positions.filter((i) => !ones.includes(i));
    const across = between(ones, zeros);
    const isSingle = Math.min(ones.length, zeros.length) === 1;
    const agreement = isSingle
      ? across / Math.sqrt(Math.max(between(ones, ones) * between(zeros, zeros), LEAST_NORM))
      : across / (ones.length * zeros.length);
    if (agreement < weakest.agreement) {
      const [apart, others] = ones.length <= zeros.length ? [ones, zeros] : [zeros, ones];
      weakest = { agreement, apart, others };
    }
  }
  return weakest;
}

/** Name the photos that differ: all of them where both groups are as large. */
function inconsistent(apart: readonly number[], others: readonly number[]): PhotoError {
  const isEven = apart.length === others.length;
  const photos = isEven ? [...apart, ...others].sort((a, b) => a - b) : apart;
  const verb = apart.length === 1 ? "does" : "do";
  const differing =
    isEven && apart.length === 1
      ? `${listed(photos)} do not look like the same person`
      : `${listed(apart)} ${verb} not look like the person on ${listed(others)}`;
  const message = `${differing}; send photos of one person only, or clearer ones`;
  return new PhotoError("inconsistent_images", message, { photos });
}

function listed(positions: readonly number[]): string {
  const numbers = positions.map((at) => String(at + 1));
  const last = numbers.pop();
  return numbers.length > 0 ? `photos ${numbers.join(", ")} and ${last}` : `photo ${last}`;
}

/**
 * Project an embedding on the generator's axes, and lift it to a private template of k numbers.
 *
 * A person's photos are averaged first and lifted once: two lifts of one embedding meet in it
 * (docs/method.md §4.6).
 *
 * @param embedding n values of norm 1.
 * @param m dimension of the subspace, 1 ≤ m < k; 2 or more for the hybrid strategy.
 */
export function lift(
  embedding: Float32Array,
  { strategy, m, generator }: { strategy: Strategy; m: number; generator: DecoyGenerator },
): AffineSubspace {
  const { k } = generator;
  const count = { random: 0, adversarial: m, hybrid: Math.floor(m / 2) }[strategy];
  if (count === undefined) {
    throw new ContractError(`this client does not lift by the strategy ${String(strategy)}`);
  }
  if (!Number.isInteger(m) || m < 1 || m >= k || (strategy !== "random" && count === 0)) {
    throw new ContractError(`m = ${m} is out of range for ${strategy} lifting of ${k} numbers`);
  }
  const point = generator.project(embedding);
  const towards = distinctDecoys(point, count, generator).map((decoy) =>
    decoy.map((value, i) => value - point[i]),
  );
  return templateThrough(point, [...towards, ...rowsOf(uniform((m - count) * k, -1, 1), k)]);
}

/** Draw decoys, and draw again where two nearly coincide, or one with the point. */
function distinctDecoys(point: Float64Array, count: number, generator: DecoyGenerator): Float64Array[] {
  for (let draw = 0; draw <= REDRAWS; draw++) {
    const decoys = generator.draw(count);
    const members = [point, ...decoys];
    const repeats = members.some((one, i) =>
      members.some((other, j) => j < i && 2 - 2 * dot(one, other) < SAME ** 2),
    );
    if (!repeats) return decoys;
  }
  throw new ContractError("the decoy generator keeps drawing the same decoy twice");
}
