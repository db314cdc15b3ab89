/** Call a running service for tests/clients/javascript/test_service.py: steps in, outcomes out. */

import { readFile } from "node:fs/promises";
import { inspect } from "node:util";

import * as ort from "onnxruntime-web";

import { Client, newHolderKey, PrivateClient, rgbImage, VeilfaceError } from "../../dist/index.js";
import { bytes, input, output } from "./io.js";

ort.env.wasm.numThreads = 1;

const { url, bearer, embedder, steps } = await input();
/** Values that later steps name by `{"kept": name}`. */
const kept = { holderKey: newHolderKey() };

const runtime = ort;
/** So many of the next answers are lost: the service has given them. */
let lose = 0;
const losing = async (...request) => {
  const response = await fetch(...request);
  if (lose-- > 0) throw new TypeError("fetch failed");
  return response;
};
const graphs = embedder && (async () => ({ embedder: await readFile(embedder) }));

/** Arguments as the package takes them. */
function given(value) {
  if (Array.isArray(value)) return value.map(given);
  if (typeof value !== "object" || value === null) return value;
  if ("kept" in value) return kept[value.kept];
  if ("png" in value) return new Blob([bytes(value.png)]);
  if ("rgb" in value) return rgbImage(bytes(value.rgb), 112, 112);
  return Object.fromEntries(Object.entries(value).map(([name, member]) => [name, given(member)]));
}

const clients = new Map();
function client(kind, as) {
  const key = `${kind} ${as}`;
  if (!clients.has(key)) {
    clients.set(
      key,
      kind === "photos"
        ? new Client(url, as, { fetch: losing })
        : new PrivateClient(url, as, { fetch: losing, runtime, ...(graphs && { graphs }) }),
    );
  }
  return clients.get(key);
}

const outcomes = [];
for (const { kind = "private", as = bearer, call, args = [], keep, lost = 0 } of steps) {
  lose = lost;
  const who = client(kind, as === bearer ? bearer : (kept[as] ?? as));
  try {
    const value = await who[call](...given(args));
    if (keep) kept[keep] = keep === "token" ? value.token : value;
    outcomes.push({ value, shown: inspect(value, { depth: 9 }) });
  } catch (error) {
    if (!(error instanceof VeilfaceError)) throw error;
    kept.lift = error.lift;
    const { code, status, details, sent, message } = error;
    outcomes.push({ code, status, details, sent, message, lift: inspect(error.lift) });
  }
}
output(outcomes);
