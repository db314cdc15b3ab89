import assert from "node:assert/strict";
import { createServer } from "node:http";
import { test } from "node:test";
import { inspect } from "node:util";

import {
  Client,
  newHolderKey,
  PrivateClient,
  VeilfaceError,
} from "../dist/index.js";

const KEY = `vf_${"0".repeat(12)}_${"5e".repeat(32)}`;
const PHOTOS = [new Blob([Uint8Array.of(1, 2, 3)])];

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
  const client = new Client(`http://127.0.0.1:${server.address().port}/`, KEY);
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

test("a subject id is sent with escapes", (t) =>
  answering(t, [decision], async (client, requests) => {
    await client.verify("Zo\u00eb_\u0928\u0947@example.org", PHOTOS);
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

test("only what was refused for load is sent again, and not for longer than the patience", async (t) => {
  for (const [status, code, after, sendings] of [
    [429, "rate_limited", "0", 4],
    [503, "overloaded", "31", 1],
    [503, "store_unavailable", "0", 1],
    [423, "locked_out", "0", 1],
  ]) {
    await answering(t, [error(status, code, { headers: { "Retry-After": after } })], async (client, requests) => {
      await assert.rejects(client.verify("anna", PHOTOS), { code });
      assert.equal(requests.length, sendings, code);
    });
  }
});

test("an error has its code, details, request and wait", (t) =>
  answering(t, [error(423, "locked_out", { headers: { "Retry-After": "31" } })], async (client) => {
    await assert.rejects(client.verify("anna", PHOTOS), (raised) => {
      assert.ok(raised instanceof VeilfaceError);
      const { code, status, details, requestId, retryAfter } = raised;
      assert.deepEqual([code, status, details, requestId, retryAfter], ["locked_out", 423, { a: 1 }, "r1", 31]);
      return true;
    });
  }));

test("a proxy's page is not repeated", (t) =>
  answering(t, [{ status: 403, body: `<p>${KEY}</p>` }], async (client) => {
    await assert.rejects(client.contract(), (raised) => {
      assert.ok(raised instanceof VeilfaceError);
      assert.equal(raised.code, "http_403");
      assert.ok(!inspect(raised).includes("5e5e"));
      return true;
    });
  }));

test("an answer that is not the service's is none", async (t) => {
  await answering(t, [{ body: { request_id: "r1", decision: "maybe" } }], (client) =>
    assert.rejects(client.verify("anna", PHOTOS), { code: "unexpected_answer" }));
  for (const body of ["<html>", "null", "[]", { decision: "accept" }]) {
    await answering(t, [{ body }], (client) => assert.rejects(client.contract(), { code: "unexpected_answer" }));
  }
  await answering(t, [{ status: 302, headers: { Location: "/elsewhere" } }], (client) =>
    assert.rejects(client.contract(), { code: "unexpected_answer" }));
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

test("keys, URLs and subjects are checked before anything is sent, and keys not repeated", async () => {
  for (const url of ["ftp://host", "https://a:b@host", "host", "https://host/#", "https://host?"]) {
    assert.throws(() => new Client(url, KEY), RangeError);
  }
  assert.throws(() => new Client("http://host", "vf_ secret"), (raised) => !raised.message.includes("secret"));
  const client = new Client("http://host", KEY);
  assert.ok(!inspect(client, { depth: 9 }).includes("5e5e"));
  for (const subject of ["", ".", "..", "a/b"]) {
    await assert.rejects(client.verify(subject, PHOTOS), RangeError);
  }
  for (const nothing of [undefined, null, 7]) {
    await assert.rejects(client.enroll(nothing, PHOTOS), RangeError);
    assert.throws(() => new Client("http://host", nothing), RangeError);
  }
});

test("more photos than the service takes are refused before they are embedded", async () => {
  const lifting = new PrivateClient("http://host", KEY, { runtime: {} });
  const photos = (count) => Array(count).fill(PHOTOS[0]);
  for (const count of [0, 6]) await assert.rejects(async () => lifting.lift(photos(count)), RangeError);
  for (const count of [0, 11]) await assert.rejects(async () => lifting.liftEnrollment(photos(count)), RangeError);
});

test("an error with open members keeps what is sound of them", (t) => {
  const body = { error: { code: "forbidden", message: "said", details: null }, request_id: 7 };
  return answering(t, [{ status: 403, body }], (client) =>
    assert.rejects(client.contract(), (raised) => {
      assert.deepEqual([raised.details, raised.requestId], [{}, undefined]);
      return true;
    }));
});

test("an error keeps its name where a minifier renames its class", () => {
  const Renamed = class extends VeilfaceError {};
  Object.defineProperty(VeilfaceError, "name", { value: "e" });
  assert.equal(new Renamed("code", "said").name, "VeilfaceError");
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
  const waiting = new Client("http://host", KEY, { timeout: 0.05, fetch: stuck });
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

test("a client is closed after what goes on, and what failed to come is fetched again", async () => {
  let asked = 0;
  const fetch = async () => {
    asked++;
    return new Response("", { status: 403 });
  };
  const client = new PrivateClient("http://host", KEY, { runtime: {}, fetch });
  const before = assert.rejects(client.prepare(), { code: "http_403" });
  await new Promise((resolve) => setTimeout(resolve));
  await client.close();
  await before;
  await assert.rejects(client.prepare(), /closed/);
  const other = new PrivateClient("http://host", KEY, { runtime: {}, fetch });
  await Promise.allSettled([other.prepare(), other.prepare()]);
  assert.equal(asked, 3);
});
