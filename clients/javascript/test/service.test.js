import assert from "node:assert/strict";
import { createServer } from "node:http";
import { test } from "node:test";
import { inspect } from "node:util";

import {
  Client,
  ConnectionFailed,
  Forbidden,
  LockedOut,
  newHolderKey,
  PrivateClient,
  signedProbe,
  Unavailable,
  UnexpectedAnswer,
} from "../dist/index.js";
import { DEFAULT_RETRIES } from "../dist/index.js";
import { FAMILIES } from "../dist/service/errors.js";
import { waitFor } from "../dist/service/retries.js";

const KEY = `vf_${"0".repeat(12)}_${"5e".repeat(32)}`;
const PHOTOS = [new Blob([Uint8Array.of(1, 2, 3)])];
const quick = { first: 0.001, longest: 0.001 };

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
const decision = { body: { decision: "reject", reason: "no_match", level: "fmr-1e-3" } };

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

test("what an enrollment may replace is a header", (t) =>
  answering(t, [{ body: { template_id: "t", replaced: false } }], async (client, requests) => {
    const holderKey = newHolderKey();
    for (const replace of [true, false, "t1"]) {
      await client.enroll("anna", PHOTOS, { replace, holderKey });
    }
    const seen = requests.map(({ headers }) => [headers["if-none-match"], headers["if-match"]]);
    assert.deepEqual(seen, [[undefined, undefined], ["*", undefined], [undefined, '"t1"']]);
    assert.equal(new Set(requests.map(({ headers }) => headers["idempotency-key"])).size, 3);
    assert.match(requests[0].body, /name="holder_key"\r\n\r\n[A-Za-z0-9_-]{43}\r\n/);
  }));

test("an overload is waited out, also by a verification", (t) =>
  answering(t, [error(503, "overloaded"), decision], async (client, requests) => {
    assert.equal((await client.verify("anna", PHOTOS)).accepted, false);
    assert.equal(requests.length, 2);
  }));

test("a verification that may have been decided is not sent again", (t) =>
  answering(t, [error(503, "store_unavailable")], async (client, requests) => {
    await assert.rejects(client.verify("anna", PHOTOS), Unavailable);
    assert.equal(requests.length, 1);
    await assert.rejects(client.erase("anna"), Unavailable);
    assert.equal(requests.length, 1 + DEFAULT_RETRIES.sendings);
  }));

test("an error has its code, details, request and wait", (t) =>
  answering(t, [error(423, "locked_out", { headers: { "Retry-After": "31" } })], async (client) => {
    await assert.rejects(client.verify("anna", PHOTOS), (raised) => {
      assert.ok(raised instanceof LockedOut);
      const { code, status, details, requestId, retryAfter } = raised;
      assert.deepEqual([code, status, details, requestId, retryAfter], ["locked_out", 423, { a: 1 }, "r1", 31]);
      return true;
    });
  }));

test("a proxy's page is not repeated", (t) =>
  answering(t, [{ status: 403, body: `<p>${KEY}</p>` }], async (client) => {
    await assert.rejects(client.contract(), (raised) => {
      assert.ok(raised instanceof Forbidden);
      assert.equal(raised.code, "http_403");
      assert.ok(!inspect(raised).includes("5e5e"));
      return true;
    });
  }));

test("an answer that is not the service's is none", async (t) => {
  await answering(t, [{ body: { decision: "maybe", level: "x" } }], (client) =>
    assert.rejects(client.verify("anna", PHOTOS), UnexpectedAnswer));
  await answering(t, [{ body: "<html>" }], (client) =>
    assert.rejects(client.contract(), UnexpectedAnswer));
  await answering(t, [{ status: 302, headers: { Location: "/elsewhere" } }], (client) =>
    assert.rejects(client.contract(), UnexpectedAnswer));
});

test("all subjects come a page at a time", (t) =>
  answering(
    t,
    [
      { body: { subjects: [{ subject_id: "a" }], next_cursor: "c" } },
      { body: { subjects: [{ subject_id: "b" }], next_cursor: null } },
    ],
    async (client, requests) => {
      const ids = [];
      for await (const { subject_id } of client.subjects(1)) ids.push(subject_id);
      assert.deepEqual(ids, ["a", "b"]);
      assert.equal(requests[1].url, "/v1/subjects?limit=1&cursor=c");
    },
  ));

test("a graph of another hash than was asked for is not taken", (t) =>
  answering(
    t,
    [{ body: { files: [{ role: "embedder", sha256: "0".repeat(64), bytes: 2 }] } }, { body: "no" }],
    (client) => assert.rejects(client.pack(), UnexpectedAnswer),
  ));

test("a wait that is longer than the patience is not waited for", () => {
  const ask = { sending: 1, resend: "when-lost", retries: DEFAULT_RETRIES };
  const told = (code, retryAfter) =>
    new FAMILIES[code]({ code, message: "said", status: 429, retryAfter });
  assert.equal(waitFor(told("rate_limited", 31), ask), undefined);
  const wait = waitFor(told("rate_limited", 5), ask);
  assert.ok(wait >= 5 && wait <= 5.25);
  assert.equal(waitFor(told("locked_out", 1), ask), undefined);
  assert.equal(waitFor(new ConnectionFailed("lost", true), { ...ask, resend: "when-not-done" }), undefined);
});

test("keys, URLs and subjects are checked before anything is sent, and keys not repeated", async () => {
  for (const url of ["ftp://host", "https://a:b@host", "host"]) {
    assert.throws(() => new Client(url, KEY), RangeError);
  }
  assert.throws(() => new Client("http://host", "vf_ secret"), (raised) => !raised.message.includes("secret"));
  assert.throws(() => new PrivateClient("http://host", "other", {}), RangeError);
  const client = new Client("http://host", KEY);
  assert.ok(!inspect(client, { depth: 9 }).includes("5e5e"));
  for (const subject of ["", "..", "a/b", "a".repeat(129)]) {
    assert.throws(() => client.verify(subject, PHOTOS), RangeError);
  }
});

test("a token signs with all of its text, a key with its secret; neither signs as the other", async () => {
  const template = Uint8Array.of(1, 2, 3);
  const fixed = { nonce: "n".repeat(16), timestamp: 1 };
  const [key, token, other] = await Promise.all(
    [KEY, `vft_${"a".repeat(300)}`, `vft_${"b".repeat(300)}`].map((bearer) =>
      signedProbe(bearer, "anna", template, fixed)),
  );
  assert.equal(new Set([key.hmac, token.hmac, other.hmac]).size, 3);
  assert.match(key.hmac, /^[0-9a-f]{64}$/);
  await assert.rejects(signedProbe("vf_other", "anna", template), RangeError);
});
