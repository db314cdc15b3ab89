/** What a page downloads of the element: bundled and minified. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { buildSync } from "esbuild";

test("the element is at most 60 kB, without a runtime in it", () => {
  const { outputFiles, metafile } = buildSync({
    entryPoints: ["dist/element/login.js"],
    bundle: true,
    minify: true,
    format: "esm",
    metafile: true,
    write: false,
  });
  assert.ok(outputFiles[0].contents.length <= 60_000, `${outputFiles[0].contents.length} bytes`);
  assert.deepEqual(Object.keys(metafile.inputs).filter((name) => !name.startsWith("dist/")), []);
});
