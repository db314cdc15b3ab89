/** Embed photos for tests/clients/javascript/test_models.py. */

import { readFile } from "node:fs/promises";

import * as ort from "onnxruntime-web";

import { ModelPack, rgbImage, VeilfaceError } from "../../dist/index.js";
import { bytes, input, output, text } from "./io.js";

ort.env.wasm.numThreads = 1;

const { contract, embedder, detector, photos } = await input();
const pack = await ModelPack.load(ort, contract, {
  embedder: await readFile(embedder),
  ...(detector && { detector: await readFile(detector) }),
});

async function sample({ data, width, height }) {
  const begun = performance.now();
  try {
    const { face, crop, quality, embedding } = await pack.embedPhoto(
      rgbImage(bytes(data), width, height),
    );
    const milliseconds = performance.now() - begun;
    return { face, crop: text(crop.data), quality, embedding: text(embedding), milliseconds };
  } catch (error) {
    if (!(error instanceof VeilfaceError)) throw error;
    return { code: error.code, message: error.message, details: error.details };
  }
}

const samples = [];
for (const photo of photos) samples.push(await sample(photo));
output(samples);
