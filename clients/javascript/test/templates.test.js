import assert from "node:assert/strict";
import { test } from "node:test";
import { inspect } from "node:util";

import { DecoyGenerator, meanEmbedding, VeilfaceError } from "../dist/index.js";
import { normal, uniform } from "../dist/templates/samples.js";
import { float16, orthonormalised, rowsOf, templateThrough } from "../dist/templates/subspace.js";

const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);

/** Let the platform draw bits that come again: a linear congruential generator (Numerical Recipes, §7.1). */
function draws(t, next) {
  t.mock.restoreAll();
  t.mock.method(crypto, "getRandomValues", (words) => words.map((_, i) => (words[i] = next())));
}
function repeating(seed) {
  let state = seed;
  return () => (state = (Math.imul(state, 1664525) + 1013904223) >>> 0);
}

test("samples are made of all 53 bits, and fit their distributions at the edges", (t) => {
  draws(t, () => 0);
  assert.deepEqual([uniform(1, -1)[0], normal(1)[0]], [-1, -0]);
  draws(t, () => 0xffffffff);
  assert.equal(uniform(1)[0], 1 - 2 ** -53);
  assert.ok(Math.abs(normal(1)[0] - Math.sqrt(106 * Math.LN2)) < 1e-12);
});

test("a template contains its point, is orthonormal, and hides which directions made it", (t) => {
  const n = 24;
  const [point, ...directions] = rowsOf(normal(6 * n), n);
  const mixed = directions.map((row, i) =>
    i === 0 ? row : row.map((value, j) => value + 2 * directions[0][j]),
  );
  const templates = [directions, mixed].map((rows) => {
    draws(t, repeating(9));
    return templateThrough(point, rows);
  });
  const rows = rowsOf(Float64Array.from(templates[0].basis), n);
  rows.forEach((row, i) =>
    rows.forEach((other, j) => assert.ok(Math.abs(dot(row, other) - (i === j ? 1 : 0)) < 1e-6)),
  );
  const gap = point.map((value, i) => value - templates[0].foot[i]);
  rows.forEach((row) => {
    const along = dot(row, gap);
    gap.forEach((value, i) => (gap[i] = value - along * row[i]));
  });
  assert.ok(Math.sqrt(dot(gap, gap)) < 1e-5);
  templates[0].basis.forEach((value, i) => assert.ok(Math.abs(value - templates[1].basis[i]) < 1e-6));
});

test("directions that depend on each other are refused", () => {
  const row = Float64Array.from([1, 2, 3]);
  assert.throws(() => orthonormalised([row, row.map((value) => 2 * value)]), { code: "unusable_contract" });
  assert.throws(() => orthonormalised([new Float64Array(3)]), { code: "unusable_contract" });
});

test("numbers are rounded to float16 as IEEE 754 says", () => {
  const cases = [
    [0, 0x0000], [-0, 0x8000], [1, 0x3c00], [-1, 0xbc00], [0.5, 0x3800], [2 ** -14, 0x0400],
    [2 ** -24, 0x0001], [2 ** -25, 0x0000], [1.5 * 2 ** -24, 0x0002], [1 - 2 ** -12, 0x3c00],
    [1 - 2 ** -11, 0x3bff], [0.1, 0x2e66], [2 ** -14 - 2 ** -25, 0x0400],
  ];
  for (const [value, bits] of cases) assert.equal(float16(value), bits, String(value));
});

test("no number of a template is printed", () => {
  assert.equal(inspect(templateThrough(Float64Array.of(0, 0.5), [Float64Array.of(1, 0)])), "{}");
});

test("photos that cancel are refused, and one that comes again counts once", () => {
  const [one, near] = [Float32Array.of(1, 0, 0), Float32Array.of(0.96, 0, 0.28)];
  assert.deepEqual(meanEmbedding([one, one, near], 0.5), meanEmbedding([one, near], 0.5));
  assert.throws(() => meanEmbedding([one, one.map((value) => -value)], -1), { code: "inconsistent_images" });
});

test("bytes that are no generator are refused without being repeated", async () => {
  const text = new TextEncoder().encode('{"secret": 1}');
  const bytes = Uint8Array.from([text.length, 0, 0, 0, 0, 0, 0, 0, ...text]);
  await assert.rejects(DecoyGenerator.fromBytes(bytes), (error) => {
    return error instanceof VeilfaceError && !error.message.includes("secret");
  });
  await assert.rejects(DecoyGenerator.fromBytes(new Uint8Array(4)), { code: "unusable_contract" });
});
