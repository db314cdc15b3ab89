/** From embeddings to private templates: `templates/space/agreement.py` and `lifting.py`. */

import { unusable, VeilfaceError } from "../errors.js";
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
 * @throws `inconsistent_images`, where they part into two groups that agree less, or cancel.
 */
export function meanEmbedding(embeddings: readonly Float32Array[], consistency: number): Float32Array {
  const same = (one: Float32Array) => (other: Float32Array) => one.every((x, i) => x === other[i]);
  const distinct = embeddings.filter((row, i) => embeddings.findIndex(same(row)) === i);
  const rows = distinct.map((row) => Float64Array.from(row));
  const mean = new Float64Array(rows[0].length);
  for (const row of rows) row.forEach((value, i) => (mean[i] += value / rows.length));
  const norm = Math.sqrt(dot(mean, mean));
  if (rows.length > 1 && (leastAgreement(rows) < consistency || norm < LEAST_MEAN)) {
    throw new VeilfaceError("inconsistent_images", "The photos do not look like one person.");
  }
  return Float32Array.from(mean, (value) => value / norm);
}

/**
 * How alike two groups of 2 to 10 photos are, -1 to 1, where they are split so that they agree least.
 *
 * One photo agrees with the others by its cosine to their mean, larger groups by the mean cosine
 * across (docs/thresholds.md "Photos of one person").
 */
function leastAgreement(rows: readonly Float64Array[]): number {
  const cosines = rows.map((one) => rows.map((other) => dot(one, other)));
  const between = (first: readonly number[], second: readonly number[]): number =>
    first.reduce((sum, i) => second.reduce((total, j) => total + cosines[i][j], sum), 0);
  let least = Infinity;
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
    least = Math.min(least, agreement);
  }
  return least;
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
    throw unusable(`this client does not lift by the strategy ${String(strategy)}`);
  }
  if (!Number.isInteger(m) || m < 1 || m >= k || (strategy !== "random" && count === 0)) {
    throw unusable(`m = ${m} is out of range for ${strategy} lifting of ${k} numbers`);
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
  throw unusable("the decoy generator keeps drawing the same decoy twice");
}
