/** From embeddings to private templates: `templates/space/lifting.py`. */

import { LiftingError } from "./errors.js";
import type { DecoyGenerator } from "./generator.js";
import { Randomness } from "./randomness.js";
import { dot, rowsOf, templateThrough, type AffineSubspace } from "./subspace.js";

/** The strategies that a decoy generator serves. */
export type Strategy = "random" | "adversarial" | "hybrid";

// Two decoys, or a decoy and the point, nearer than this would add a direction of noise.
const SAME = 1e-3;
const REDRAWS = 16;

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
  {
    strategy,
    m,
    generator,
    randomness = new Randomness(),
  }: { strategy: Strategy; m: number; generator: DecoyGenerator; randomness?: Randomness },
): AffineSubspace {
  const { k } = generator;
  const count = decoysOf(strategy, m);
  if (!Number.isInteger(m) || m < 1 || m >= k || (strategy !== "random" && count === 0)) {
    throw new LiftingError(`m = ${m} is out of range for ${strategy} lifting of ${k} numbers`);
  }
  const projected = Float64Array.from(generator.project(embedding));
  const norm = Math.sqrt(dot(projected, projected));
  const point = projected.map((value) => value / norm);
  const directions = decoys(point, count, generator, randomness);
  for (const decoy of directions) decoy.forEach((value, i) => (decoy[i] = value - point[i]));
  directions.push(...rowsOf(randomness.uniform((m - count) * k, -1, 1), k));
  return templateThrough(point, directions, randomness);
}

/** Number of decoys among `m` directions: all, half (rounded down) or none. */
function decoysOf(strategy: Strategy, m: number): number {
  switch (strategy) {
    case "random":
      return 0;
    case "adversarial":
      return m;
    case "hybrid":
      return Math.floor(m / 2);
    default:
      throw new LiftingError(`this client does not lift by the strategy ${String(strategy)}`);
  }
}

/** Draw decoys, and draw again where two nearly coincide, or one with the point. */
function decoys(
  point: Float64Array,
  count: number,
  generator: DecoyGenerator,
  randomness: Randomness,
): Float64Array[] {
  for (let draw = 0; draw <= REDRAWS; draw++) {
    const drawn = generator.draw(count, randomness);
    const members = [point, ...drawn];
    const repeats = members.some((one, i) =>
      members.some((other, j) => j < i && 2 - 2 * dot(one, other) < SAME ** 2),
    );
    if (!repeats) return drawn;
  }
  throw new LiftingError("the decoy generator keeps drawing the same decoy twice");
}
