/** From descriptors to private templates: `templates/space/lifting.py`. */

import { LiftingError } from "./errors.js";
import type { DecoyGenerator } from "./generator.js";
import type { Keystream } from "./randomness.js";
import { rowsOf, templateThrough, type AffineSubspace } from "./subspace.js";

/** The strategies that a decoy generator serves. */
export type Strategy = "random" | "adversarial" | "hybrid";

const UNIT_TOLERANCE = 1e-3;
// Two decoys, or a decoy and the descriptor, nearer than this would add a direction of noise.
const SAME = 1e-3;
const REDRAWS = 16;

/**
 * Lift a descriptor to a private template.
 *
 * A person's photos are averaged first and lifted once: two lifts of one descriptor meet in it
 * (docs/method.md §4.6).
 *
 * @param descriptor n values of norm 1.
 * @param m dimension of the subspace, 1 ≤ m < n; 2 or more for the hybrid strategy.
 * @param stream a fresh one for each template, destroyed afterwards.
 */
export function lift(
  descriptor: ArrayLike<number>,
  {
    strategy,
    m,
    generator,
    stream,
  }: { strategy: Strategy; m: number; generator: DecoyGenerator; stream: Keystream },
): AffineSubspace {
  const n = descriptor.length;
  const k = decoysOf(strategy, m);
  if (!Number.isInteger(m) || m < 1 || m >= n || (strategy !== "random" && k === 0)) {
    throw new LiftingError(`m = ${m} is out of range for ${strategy} lifting of ${n} numbers`);
  }
  if (generator.n !== n) {
    throw new LiftingError(`decoys of ${generator.n} numbers do not fit embeddings of ${n}`);
  }
  let point = Float64Array.from(descriptor);
  const norm = Math.sqrt(dot(point, point));
  if (!(Math.abs(norm - 1) <= UNIT_TOLERANCE)) {
    throw new LiftingError("an embedding must have norm 1; L2-normalise it");
  }
  point = point.map((value) => value / norm);
  if (k > 0 && generator.noise > 0) {
    const deviation = Math.sqrt(generator.noise);
    const noise = stream.normal(n);
    point = point.map((value, i) => value + deviation * noise[i]);
    const length = Math.sqrt(dot(point, point));
    point = point.map((value) => value / length);
  }
  const directions = k > 0 ? decoys(point, k, generator, stream) : [];
  for (const decoy of directions) decoy.forEach((value, i) => (decoy[i] = value - point[i]));
  if (k < m) directions.push(...rowsOf(stream.uniform((m - k) * n, -1, 1), n));
  return templateThrough(point, directions, stream);
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

/** Draw decoys, and draw again where two nearly coincide, or one with the descriptor. */
function decoys(
  point: Float64Array,
  k: number,
  generator: DecoyGenerator,
  stream: Keystream,
): Float64Array[] {
  for (let draw = 0; draw <= REDRAWS; draw++) {
    const drawn = generator.draw(k, stream);
    const members = [point, ...drawn];
    const repeats = members.some((one, i) =>
      members.some((other, j) => j < i && 2 - 2 * dot(one, other) < SAME ** 2),
    );
    if (!repeats) return drawn;
  }
  throw new LiftingError("the decoy generator keeps drawing the same decoy twice");
}

const dot = (a: Float64Array, b: Float64Array): number => {
  let sum = 0;
  for (let i = 0; i < a.length; i++) sum += a[i] * b[i];
  return sum;
};
