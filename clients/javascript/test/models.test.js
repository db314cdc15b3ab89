import assert from "node:assert/strict";
import { test } from "node:test";
import { inspect } from "node:util";

import { decodeImage, fromImageData, ModelPack, rgbImage, sha256, VeilfaceError } from "../dist/index.js";
import { similarityTransform, template } from "../dist/models/alignment.js";
import { letterbox } from "../dist/models/detection.js";
import { intersectionOverUnion, nonMaximumSuppression, selectFace } from "../dist/models/faces.js";
import { resizeArea, resizeLinear, roundHalfEven, warpAffine } from "../dist/models/image.js";
import { measurePose, requireQuality } from "../dist/models/quality.js";

const face = (box, score = 0.9) => ({ box, score, keypoints: template(112) });
const flat = (width, height, value) =>
  rgbImage(new Uint8Array(3 * width * height).fill(value), width, height);

test("a canvas gives RGB without its alpha", () => {
  const image = fromImageData({ data: [1, 2, 3, 255, 4, 5, 6, 0], width: 2, height: 1 });
  assert.deepEqual([...image.data], [1, 2, 3, 4, 5, 6]);
  assert.throws(() => rgbImage(new Uint8Array(5), 1, 2), RangeError);
});

test("halves are rounded to the even number", () => {
  assert.deepEqual([0.5, 1.5, 2.5, -0.5, 1.4, 1.6].map(roundHalfEven), [0, 2, 2, 0, 1, 2]);
});

test("resizing keeps a flat picture flat, and a ramp a ramp", () => {
  for (const resize of [resizeLinear, resizeArea]) {
    assert.ok(resize(flat(50, 40, 77), 31, 23).data.every((value) => value === 77));
  }
  const ramp = rgbImage(Uint8Array.from({ length: 30 }, (_, i) => 20 * Math.floor(i / 3)), 10, 1);
  const twice = resizeLinear(ramp, 20, 1).data.filter((_, i) => i % 3 === 0);
  assert.deepEqual([...twice.subarray(0, 6)], [0, 5, 15, 25, 35, 45]);
  assert.deepEqual([...resizeArea(ramp, 5, 1).data.filter((_, i) => i % 3 === 0)], [10, 50, 90, 130, 170]);
});

test("a warp moves pixels, and is black outside", () => {
  const image = flat(4, 4, 200);
  const moved = warpAffine(image, [1, 0, 1, 0, 1, 0], 4).data;
  assert.deepEqual([...moved.subarray(0, 12)], [0, 0, 0, ...Array(9).fill(200)]);
  assert.equal(warpAffine(image, [1, 0, 0.5, 0, 1, 0], 4).data[0], 100);
});

test("a similarity is found again", () => {
  const [a, b, x, y] = [1.3, 0.4, 7, -3];
  const moved = template(112).map(([u, v]) => [a * u - b * v + x, b * u + a * v + y]);
  const matrix = similarityTransform(template(112), moved);
  [a, -b, x, b, a, y].forEach((value, i) => assert.ok(Math.abs(matrix[i] - value) < 1e-9));
  assert.throws(() => similarityTransform(Array(5).fill([1, 1]), template(112)), RangeError);
  assert.throws(() => template(100), { code: "unusable_contract" });
});

test("the better of two boxes that overlap is kept", () => {
  const boxes = [face([0, 0, 10, 10], 0.7), face([1, 0, 11, 10], 0.9), face([50, 0, 60, 10], 0.6)];
  assert.deepEqual(nonMaximumSuppression(boxes, 0.4).map(({ score }) => score), [0.9, 0.6]);
  assert.equal(intersectionOverUnion([0, 0, 10, 10], [0, 0, 10, 20]), 0.5);
});

test("a picture lies in the corner of its canvas, its sides cut to whole pixels", () => {
  const { canvas, scale } = letterbox(flat(300, 200, 9), [640, 640], true);
  assert.equal(scale, 426 / 200);
  assert.deepEqual([canvas.data[3 * (425 * 640)], canvas.data[3 * (426 * 640)]], [9, 0]);
  assert.equal(letterbox(flat(300, 200, 9), [640, 640], false).scale, 1);
});

test("the face that is meant is the one that its policy singles out", () => {
  const boxes = [[0, 0, 9, 9], [40, 40, 140, 140], [150, 0, 220, 70], [150, 0, 235, 85], [0, 0, 110, 110]];
  const [speck, main, half, near, aside] = boxes.map((box) => face(box));
  const among = (faces, policy) => selectFace(faces, policy, { width: 240, height: 240 }, 24);
  for (const policy of ["dominant", "largest", "single"]) {
    assert.equal(among([speck, main], policy), main);
    assert.throws(() => among([], policy), { code: "no_face" });
  }
  assert.equal(among([half, main], "dominant"), main);
  assert.throws(() => among([main, half], "single"), { code: "multiple_faces" });
  assert.throws(() => among([main, near], "dominant"), { code: "multiple_faces" });
  assert.equal(among([near, main], "largest"), main);
  assert.throws(() => among([main, aside], "largest"), { code: "multiple_faces" });
  assert.throws(() => among([aside, half], "dominant"), { code: "multiple_faces" });
  assert.equal(among([half, aside], "largest"), aside);
});

test("every limit that a face fails is named", () => {
  const quality = { score: 0.3, face_size: 90, sharpness: 0.1, brightness: 250, exposure: 255, yaw: -80, pitch: 0, roll: 0, border: -1, aspect: 1 };
  assert.throws(
    () => requireQuality(quality, 0.6),
    (error) =>
      error.code === "low_quality" &&
      Object.keys(error.details).join() === "score,blur,brightness,pose,hidden" &&
      error.details.pose.yaw.limit === 70,
  );
  const straight = measurePose(template(112));
  assert.ok(Math.abs(straight.roll) < 1e-9 && Math.abs(straight.yaw) < 10);
});

test("a graph is not run before its hash is that of the contract", async () => {
  const runtime = { InferenceSession: { create: () => assert.fail("it was loaded") } };
  const preprocessing = { version: 2, alignment: "arcface-112", size: 112 };
  const contract = { binding: { embedder_sha256: "0".repeat(64), preprocessing, n: 4 }, recorded: {} };
  const graphs = { embedder: new Uint8Array(3) };
  await assert.rejects(ModelPack.load(runtime, contract, graphs), /the contract names 0000/);
  const detector = { ...graphs, detector: new Uint8Array(3) };
  await assert.rejects(ModelPack.load(runtime, contract, detector), { code: "unusable_contract" });
});

/** A runtime whose graphs have this many outputs, and those that are held. */
function runtimeOf(outputs, run = async () => ({})) {
  const held = new Set();
  const create = async () => {
    const session = {
      inputNames: ["x"],
      inputMetadata: [{ shape: [1, 3, 112, 112] }],
      outputNames: Array.from({ length: outputs }, (_, i) => String(i)),
      run,
      release: async () => void held.delete(session),
    };
    held.add(session);
    return session;
  };
  return { held, runtime: { InferenceSession: { create }, Tensor: class {} } };
}
const sizes = { version: 2, alignment: "arcface-112", size: 112, mean: [0, 0, 0], scale: [1, 1, 1] };

test("what was loaded is freed where a later graph is refused", async () => {
  const { held, runtime } = runtimeOf(2);
  const bytes = new Uint8Array(3);
  const hash = await sha256(bytes);
  const binding = { embedder_sha256: hash, preprocessing: sizes, n: 4 };
  const contract = (detector_sha256) => ({ binding, recorded: { detector_sha256 } });
  const graphs = { embedder: bytes, detector: bytes };
  await assert.rejects(ModelPack.load(runtime, contract("0".repeat(64)), graphs), { code: "unusable_contract" });
  await assert.rejects(ModelPack.load(runtime, contract(hash), graphs), /neither SCRFD/);
  assert.equal(held.size, 0);
});

test("no pixel and no number of an embedding is printed", async () => {
  const { runtime } = runtimeOf(1, async () => ({ 0: { dims: [1, 4], data: Float32Array.of(0, 3, 0, 4) } }));
  const bytes = new Uint8Array(3);
  const binding = { embedder_sha256: await sha256(bytes), preprocessing: sizes, n: 4 };
  const pack = await ModelPack.load(runtime, { binding, recorded: {} }, { embedder: bytes });
  const noise = Uint8Array.from({ length: 3 * 112 * 112 }, (_, i) => (i * 7919) % 251);
  const sample = await pack.embedPhoto(rgbImage(noise, 112, 112));
  assert.deepEqual([...sample.embedding], [0, Math.fround(0.6), 0, Math.fround(0.8)]);
  for (const shown of [inspect(sample, { depth: 9 }), JSON.stringify(sample)]) {
    assert.ok(!/crop|embedding|0\.6/.test(shown), shown);
  }
});

test("what ONNX Runtime and the browser throw has this package's classes", async () => {
  const { runtime } = runtimeOf(1, async () => {
    throw new Error("out of memory");
  });
  const bytes = new Uint8Array(3);
  const binding = { embedder_sha256: await sha256(bytes), preprocessing: sizes, n: 4 };
  const pack = await ModelPack.load(runtime, { binding, recorded: {} }, { embedder: bytes });
  const noise = Uint8Array.from({ length: 3 * 112 * 112 }, (_, i) => (i * 7919) % 251);
  await assert.rejects(pack.embedPhoto(rgbImage(noise, 112, 112)), { code: "unusable_contract" });
  globalThis.createImageBitmap = async () => {
    throw new DOMException("not decoded", "InvalidStateError");
  };
  await assert.rejects(decodeImage(new Blob(["text"])), (error) =>
    error instanceof VeilfaceError && error.code === "unsupported_image");
});

test("a check says what a refusal would, and embeds nothing", async () => {
  const { runtime } = runtimeOf(1, async () => assert.fail("it was embedded"));
  const bytes = new Uint8Array(3);
  const binding = { embedder_sha256: await sha256(bytes), preprocessing: sizes, n: 4 };
  const pack = await ModelPack.load(runtime, { binding, recorded: {} }, { embedder: bytes });
  const noise = Uint8Array.from({ length: 3 * 112 * 112 }, (_, i) => (i * 7919) % 251);
  assert.equal(await pack.checkPhoto(rgbImage(noise, 112, 112)), undefined);
  const dark = await pack.checkPhoto(flat(112, 112, 3));
  await assert.rejects(pack.embedPhoto(flat(112, 112, 3)), (error) => {
    assert.deepEqual(dark, error);
    return error.code === "low_quality";
  });
  // What is no photo of a face at all stays an error.
  await assert.rejects(pack.checkPhoto(flat(112, 100, 3)), /square/);
});
