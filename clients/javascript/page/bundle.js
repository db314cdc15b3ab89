// What the service's own page runs in private mode: the client, bundled, and ONNX Runtime's WebAssembly,
// compressed once for all, into api/web/client.

import { buildSync } from "esbuild";
import { copyFileSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const RUNTIME = "node_modules/onnxruntime-web/dist/";
const FOLDER = "../../api/web/client/";

const [{ contents }] = buildSync({
  entryPoints: ["page/client.js"],
  bundle: true,
  minify: true,
  format: "esm",
  legalComments: "none",
  write: false,
}).outputFiles;
const files = {
  "client.js": contents,
  // They name each other, so they keep their names.
  "ort.wasm.min.mjs": readFileSync(`${RUNTIME}ort.wasm.min.mjs`),
  "ort-wasm-simd-threaded.mjs": readFileSync(`${RUNTIME}ort-wasm-simd-threaded.mjs`),
  "ort-wasm-simd-threaded.wasm": readFileSync(`${RUNTIME}ort-wasm-simd-threaded.wasm`),
};
rmSync(FOLDER, { recursive: true, force: true });
mkdirSync(FOLDER, { recursive: true });
for (const [name, bytes] of Object.entries(files)) {
  writeFileSync(`${FOLDER}${name}.gz`, gzipSync(bytes, { level: 9 }));
}
copyFileSync("page/onnxruntime.LICENSE", `${FOLDER}onnxruntime.LICENSE`);
