import assert from "node:assert/strict";
import { createServer } from "node:http";
import { test } from "node:test";
import { inspect } from "node:util";

import {
  Client,
  ConnectionFailed,
  DEFAULT_RETRIES,
  newHolderKey,
  PrivateClient,
  ServiceError,
  UnexpectedAnswer,
} from "../dist/index.js";
import * as errors from "../dist/errors.js";
import { waitFor } from "../dist/service/sending.js";

const KEY = `vf_${"0".repeat(12)}_${"5e".repeat(32)}`;
const PHOTOS = [new Blob([Uint8Array.of(1, 2, 3)])];
const quick = { patience: 0.001 };

/** A server that gives these answers in turn, and the requests that it got. */
async function answering(t, answers, use) {
  const requests = [];
  const server = createServer((request, response) => {
    const chunks = [];
    request.on("data", (chunk) => chunks.push(chunk));
    request.on("end", () => {
      requests.push({ ...request, method: request.method, url: request.url, headers: request.headers,
        body: Buffer.concat(chunks).toString("latin1") });
      const { status = 200, headers = {}, body = {} } = answers[Math.min(requests.length, answers.length) - 1];
      response.writeHead(status, headers).end(typeof body === "string" ? body : JSON.stringify(body));
    });
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  t.after(() => server.close());
  const client = new Client(`http://127.0.0.1:${server.address().port}/`, KEY, { retries: quick });
  return use(client, requests);
}

const error = (status, code, more = {}) => ({
  status,
  body: { error: { code, message: "said", details: { a: 1 } }, request_id: "r1" },
  ...more,
});
const decision = { body: { request_id: "r1", decision: "reject", reason: "no_match", level: "fmr-1e-3" } };

test("a rejection is a decision that was not accepted", (t) =>
  answering(t, [decision], async (client, requests) => {
    const { accepted, reason } = await client.verify("anna", PHOTOS, { level: "fmr-1e-3" });
    assert.deepEqual([accepted, reason], [false, "no_match"]);
    const [{ method, url, headers, body }] = requests;
    assert.deepEqual([method, url], ["POST", "/v1/subjects/anna/verify"]);
    assert.equal(headers.authorization, `Bearer ${KEY}`);
    assert.match(body, /name="image"; filename="photo"/);
    assert.match(body, /name="level"\r\n\r\nfmr-1e-3\r\n/);
  }));

test("two photos are compared, and asked for again after a lost answer", (t) =>
  answering(t, [error(503, "store_unavailable"), decision], async (client, requests) => {
    const { accepted } = await client.compare(...PHOTOS, ...PHOTOS, { level: "fmr-1e-3" });
    assert.equal(accepted, false);
    assert.equal(requests.length, 2);
    const [{ method, url, body }] = requests;
    assert.deepEqual([method, url], ["POST", "/v1/compare"]);
    assert.equal(body.match(/name="images"; filename="photo"/g).length, 2);
    assert.match(body, /name="level"\r\n\r\nfmr-1e-3\r\n/);
  }));

test("a subject id is sent in one spelling, with escapes", (t) =>
  answering(t, [decision], async (client, requests) => {
    await client.verify("Zoe\u0308_\u0928\u0947@example.org", PHOTOS);
    assert.equal(requests[0].url, "/v1/subjects/Zo%C3%AB_%E0%A4%A8%E0%A5%87%40example.org/verify");
  }));

test("what an enrollment may replace is a header", (t) =>
  answering(t, [{ body: { request_id: "r1", template_id: "t", replaced: false } }], async (client, requests) => {
    const holderKey = newHolderKey();
    for (const replace of [true, false, "t1"]) {
      await client.enroll("anna", PHOTOS, { replace, holderKey });
    }
    const seen = requests.map(({ headers }) => [headers["if-none-match"], headers["if-match"]]);
    assert.deepEqual(seen, [[undefined, undefined], ["*", undefined], [undefined, '"t1"']]);
    assert.match(requests[0].body, /name="holder_key"\r\n\r\n[A-Za-z0-9_-]{43}\r\n/);
  }));

test("an overload is waited out, also by a verification", (t) =>
  answering(t, [error(503, "overloaded"), decision], async (client, requests) => {
    assert.equal((await client.verify("anna", PHOTOS)).accepted, false);
    assert.equal(requests.length, 2);
  }));

test("a verification that may have been decided is not sent again", (t) =>
  answering(t, [error(503, "store_unavailable")], async (client, requests) => {
    await assert.rejects(client.verify("anna", PHOTOS), { code: "store_unavailable" });
    assert.equal(requests.length, 1);
    await assert.rejects(client.erase("anna"), { code: "store_unavailable" });
    assert.equal(requests.length, 1 + DEFAULT_RETRIES.sendings);
  }));

test("an error has its code, details, request and wait", (t) =>
  answering(t, [error(423, "locked_out", { headers: { "Retry-After": "31" } })], async (client) => {
    await assert.rejects(client.verify("anna", PHOTOS), (raised) => {
      assert.ok(raised instanceof ServiceError);
      const { code, status, details, requestId, retryAfter } = raised;
      assert.deepEqual([code, status, details, requestId, retryAfter], ["locked_out", 423, { a: 1 }, "r1", 31]);
      return true;
    });
  }));

test("a proxy's page is not repeated", (t) =>
  answering(t, [{ status: 403, body: `<p>${KEY}</p>` }], async (client) => {
    await assert.rejects(client.contract(), (raised) => {
      assert.ok(raised instanceof ServiceError);
      assert.equal(raised.code, "http_403");
      assert.ok(!inspect(raised).includes("5e5e"));
      return true;
    });
  }));

test("an answer that is not the service's is none", async (t) => {
  await answering(t, [{ body: { request_id: "r1", decision: "maybe" } }], (client) =>
    assert.rejects(client.verify("anna", PHOTOS), UnexpectedAnswer));
  for (const body of ["<html>", "null", "[]", { decision: "accept" }]) {
    await answering(t, [{ body }], (client) => assert.rejects(client.contract(), UnexpectedAnswer));
  }
  await answering(t, [{ status: 302, headers: { Location: "/elsewhere" } }], (client) =>
    assert.rejects(client.contract(), UnexpectedAnswer));
});

test("all subjects come a page at a time", (t) =>
  answering(
    t,
    [
      { body: { request_id: "r1", subjects: [{ subject_id: "a" }], next_cursor: "c" } },
      { body: { request_id: "r1", subjects: [{ subject_id: "b" }], next_cursor: null } },
    ],
    async (client, requests) => {
      const ids = [];
      for await (const { subject_id } of client.subjects(1)) ids.push(subject_id);
      assert.deepEqual(ids, ["a", "b"]);
      assert.equal(requests[1].url, "/v1/subjects?limit=1&cursor=c");
    },
  ));

test("what may heal is waited for, and nothing longer than the patience", () => {
  const ask = { sending: 1, call: {}, retries: DEFAULT_RETRIES };
  const once = { ...ask, call: { onlyOnce: true } };
  const answered = (code, status, retryAfter) => new ServiceError({ code, message: "said", status, retryAfter });
  const wait = waitFor(answered("rate_limited", 429, 5), ask);
  assert.ok(wait >= 5 && wait <= 5.25);
  const lost = (sent) => new ConnectionFailed("lost", sent);
  for (const [error, asked, heals] of [
    [answered("rate_limited", 429, 31), ask, false],
    [answered("locked_out", 423, 1), ask, false],
    [answered("overloaded", 503), once, true],
    [answered("store_unavailable", 503), ask, true],
    [answered("store_unavailable", 503), once, false],
    [answered("model_unavailable", 503), ask, false],
    [lost(true), ask, true],
    [lost(true), once, false],
    [lost(false), once, true],
    [lost(true), { ...ask, sending: DEFAULT_RETRIES.sendings }, false],
  ]) {
    assert.equal(waitFor(error, asked) !== undefined, heals, error.code);
  }
});

test("keys, URLs and subjects are checked before anything is sent, and keys not repeated", async () => {
  for (const url of ["ftp://host", "https://a:b@host", "host", "https://host/#", "https://host?"]) {
    assert.throws(() => new Client(url, KEY), RangeError);
  }
  assert.throws(() => new Client("http://host", "vf_ secret"), (raised) => !raised.message.includes("secret"));
  const client = new Client("http://host", KEY);
  assert.ok(!inspect(client, { depth: 9 }).includes("5e5e"));
  for (const subject of ["", "..", "a/b", "a b", "a\u200b", "a".repeat(129)]) {
    await assert.rejects(client.verify(subject, PHOTOS), RangeError);
  }
  for (const nothing of [undefined, null, 7]) {
    await assert.rejects(client.enroll(nothing, PHOTOS), TypeError);
    await assert.rejects(client.tokenOutcome("anna", nothing), TypeError);
    assert.throws(() => new Client("http://host", nothing), TypeError);
  }
});

test("more photos than the service takes are refused before they are sent or embedded", (t) =>
  answering(t, [decision], async (client, requests) => {
    const lifting = new PrivateClient(client.url, KEY, { runtime: {} });
    const photos = (count) => Array(count).fill(PHOTOS[0]);
    for (const count of [0, 6]) {
      await assert.rejects(async () => client.verify("anna", photos(count)), RangeError);
      await assert.rejects(async () => lifting.lift(photos(count)), RangeError);
    }
    for (const count of [0, 11]) {
      await assert.rejects(async () => client.enroll("anna", photos(count)), RangeError);
      await assert.rejects(async () => lifting.liftEnrollment(photos(count)), RangeError);
    }
    assert.equal(requests.length, 0);
    await client.verify("anna", photos(6), { challenge: { challenge_id: "c", max_frames: 6 } });
    assert.equal(requests.length, 1);
  }));

test("an error with open members keeps what is sound of them", (t) => {
  const body = { error: { code: "forbidden", message: "said", details: null }, request_id: 7 };
  return answering(t, [{ status: 403, body }], (client) =>
    assert.rejects(client.contract(), (raised) => {
      assert.deepEqual([raised.details, raised.requestId], [{}, undefined]);
      return true;
    }));
});

test("errors keep their names where a minifier renames their classes", () => {
  for (const [name, family] of Object.entries(errors)) {
    if (!(family.prototype instanceof Error)) continue;
    const Renamed = { [name]: class extends family {} }[name];
    Object.defineProperty(Renamed, "name", { value: "t" });
    Object.defineProperty(family, "name", { value: "e" });
    assert.equal(new Renamed({ message: "said" }).name, name);
  }
});

/** Bytes that come in pieces, each when it is asked for. */
const inPieces = (pull) => new Response(new ReadableStream({ pull }, { highWaterMark: 0 }));

test("a graph may take longer than the timeout, but not stand still for it", async () => {
  const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  let pieces = 0;
  const slow = async () =>
    inPieces(async (stream) => {
      await pause(100);
      if (++pieces <= 15) stream.enqueue(Uint8Array.of(pieces));
      else stream.close();
    });
  const patient = new Client("http://host", KEY, { timeout: 1, fetch: slow });
  assert.deepEqual([...(await patient.generator())], Array.from({ length: 15 }, (_, i) => i + 1));
  const stuck = async (_, { signal }) =>
    inPieces((stream) => new Promise((resolve) => {
      signal.addEventListener("abort", () => resolve(stream.error(signal.reason)));
    }));
  const retries = { sendings: 1 };
  const waiting = new Client("http://host", KEY, { timeout: 0.05, fetch: stuck, retries });
  await assert.rejects(waiting.generator(), /took too long/);
});

test("a signal ends what runs, and whatever is called after it", async () => {
  const ended = new AbortController();
  let sent = 0;
  const client = new Client("http://host", KEY, {
    signal: ended.signal,
    fetch: (_, { signal }) => {
      sent++;
      return new Promise((_resolve, reject) =>
        signal.addEventListener("abort", () => reject(signal.reason)));
    },
  });
  const call = assert.rejects(client.contract(), { name: "AbortError" });
  await new Promise((resolve) => setTimeout(resolve));
  ended.abort();
  await call;
  await assert.rejects(client.contract(), { name: "AbortError" });
  assert.equal(sent, 1);
});

test("clients that share what they fetched fetch it once, and again after a failure", async () => {
  let asked = 0;
  const fetch = async () => {
    asked++;
    return new Response("", { status: 403 });
  };
  const client = new PrivateClient("http://host", KEY, { runtime: {}, fetch });
  const other = client.as(KEY);
  const both = await Promise.allSettled([client.prepare(), other.prepare()]);
  assert.deepEqual([both.map(({ status }) => status), asked], [["rejected", "rejected"], 1]);
  await client.close();
  await assert.rejects(client.prepare(), /closed/);
  await assert.rejects(other.prepare(), ServiceError);
  assert.equal(asked, 2);
});

test("a client that is closed while its preparation fails says nothing, and is closed", async () => {
  const retries = { sendings: 1 };
  const fetch = async () => new Response("", { status: 503 });
  const client = new PrivateClient("http://host", KEY, { runtime: {}, retries, fetch });
  const preparing = assert.rejects(client.prepare(), { code: "http_503" });
  await client.close();
  await preparing;
  await assert.rejects(client.prepare(), /closed/);
  assert.throws(() => client.as(KEY), /closed/);
});
