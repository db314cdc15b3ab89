/** The element in a page that has only what it uses of one; in a browser: tests/web. */

import assert from "node:assert/strict";
import { test } from "node:test";

const { VeilfaceLogin: ForServers } = await import("../dist/element/login.js?rendered-by-a-server");

class Part {
  static all = {};
  part = { add: (name) => (Part.all[name] = this) };
  append() {}
  attributes = {};
  #clicked = () => {};
  addEventListener(_, listener) { this.#clicked = listener; }
  click() { this.#clicked(); }
  setAttribute(name, value) { this.attributes[name] = value; }
  play() { return Promise.resolve(); }
  videoWidth = 4;
  videoHeight = 4;
}

class Page extends EventTarget {
  // What a page has before its element is known becomes it: the constructor returns it.
  static known;
  isConnected = false;
  #attributes = new Map();
  constructor() {
    super();
    if (Page.known) return Object.setPrototypeOf(Page.known, new.target.prototype);
  }
  getAttribute(name) { return this.#attributes.get(name) ?? null; }
  setAttribute(name, value) {
    const old = this.getAttribute(name);
    this.#attributes.set(name, value);
    if (this.constructor.observedAttributes?.includes(name)) this.attributeChangedCallback(name, old, value);
  }
  enter() {
    this.isConnected = true;
    this.connectedCallback();
  }
  leave() {
    this.isConnected = false;
    this.disconnectedCallback();
  }
  attachShadow() {
    return { append: () => Object.assign(this, Part.all) };
  }
}

Object.assign(globalThis, {
  HTMLElement: Page,
  document: { createElement: () => new Part() },
  CSSStyleSheet: class { replaceSync() {} },
  OffscreenCanvas: class {
    constructor(width, height) { Object.assign(this, { width, height }); }
    getContext() {
      const [width, height] = [this.width, this.height];
      const data = new Uint8Array(4 * width * height);
      return { canvas: this, drawImage() {}, getImageData: () => ({ data, width, height }) };
    }
  },
});
const { VeilfaceLogin, VeilfaceError, WORDS } = await import("../dist/element/login.js");

const settled = () => new Promise((resolve) => setTimeout(resolve));

/** An element in a page, the tracks of its camera, and what it told. */
function element({ authorize, fetch, camera = async () => {} } = {}) {
  const tracks = [];
  Object.defineProperty(globalThis, "navigator", {
    configurable: true,
    value: {
      mediaDevices: {
        getUserMedia: async () => {
          await camera();
          const track = Object.assign(new EventTarget(), { stopped: false, stop() { this.stopped = true; } });
          tracks.push(track);
          return { getTracks: () => [track] };
        },
      },
    },
  });
  const login = new VeilfaceLogin();
  const told = [];
  for (const name of ["veilface-result", "veilface-error"]) {
    login.addEventListener(name, ({ detail }) => told.push(detail));
  }
  login.setAttribute("service", "http://127.0.0.1:1");
  login.options = { runtime: {}, fetch };
  login.authorize = authorize;
  login.enter();
  return { login, tracks, told };
}

test("a server that renders pages can import it", () => {
  assert.equal(typeof ForServers, "function");
});

test("what a page sets before the element is known stays", () => {
  const early = new Page();
  const given = { options: { runtime: {} }, authorize: async () => {}, words: { start: "Kamera an" } };
  Object.assign(early, given);
  Page.known = early;
  try {
    const { options, authorize, words } = new VeilfaceLogin();
    assert.deepEqual([options, authorize, words.start], [given.options, given.authorize, "Kamera an"]);
    assert.deepEqual(words, { ...WORDS, start: "Kamera an" });
  } finally {
    Page.known = undefined;
  }
  assert.equal(new VeilfaceLogin().words.start, "Start camera");
});

test("a camera that is granted after the element left is stopped at once", async () => {
  let grant;
  const { login, tracks, told } = element({ camera: () => new Promise((resolve) => (grant = resolve)) });
  login.button.click();
  await settled();
  login.leave();
  grant();
  await settled();
  assert.deepEqual([tracks.map(({ stopped }) => stopped), told], [[true], []]);
});

test("an attempt ends with the element: no token is asked for, and nothing told", async () => {
  let tokens = 0;
  let sent;
  const aborted = new Promise((resolve) => {
    sent = (_, { signal }) =>
      new Promise((_resolve, reject) => {
        signal.addEventListener("abort", () => {
          resolve();
          reject(signal.reason);
        });
      });
  });
  const authorize = async () => ({ subject: "anna", token: `vft_${"a".repeat(20)}${tokens++}` });
  const { login, tracks, told } = element({ authorize, fetch: sent });
  login.button.click();
  await settled();
  const attempt = assert.rejects(login.attempt(), { name: "AbortError" });
  await settled();
  login.leave();
  await Promise.all([aborted, attempt]);
  await settled();
  assert.deepEqual([tokens, tracks.map(({ stopped }) => stopped), told], [1, [true], []]);
});

test("graphs are fetched while the person looks, and what failed is tried again by the attempt", async () => {
  const asked = [];
  const fetch = async (url, { headers }) => {
    asked.push([new URL(url).pathname, headers.Authorization.slice(-1)]);
    return new Response("", { status: 503 });
  };
  let tokens = 0;
  const authorize = async () => ({ subject: "anna", token: `vft_${"a".repeat(20)}${tokens++}` });
  const { login, told } = element({ authorize, fetch });
  login.button.click();
  await settled();
  assert.deepEqual(asked, [["/v1/contract", "0"]], "while the person looks");
  login.words = { ...login.words, errors: { http_503: "Später." } };
  await assert.rejects(login.attempt(), { code: "http_503" });
  assert.deepEqual(asked[1], ["/v1/contract", "1"], "what failed is tried again");
  login.button.click();
  while (told.length === 0) await settled();
  assert.equal(login.status.value, "Später.");
});

test("words that are given late are shown, and those that are not stay in English", () => {
  const { login } = element();
  login.words = { start: "Kamera an", hints: { blur: "Stillhalten." } };
  assert.equal(login.button.textContent, "Kamera an");
  const { blur, pose } = login.words.hints;
  assert.deepEqual([blur, pose], ["Stillhalten.", "Look straight into the camera."]);
});

test("an element without a runtime says so", async () => {
  const { login } = element({ authorize: async () => ({ subject: "anna", token: "vft_" }) });
  login.options = {};
  await assert.rejects(login.attempt(), /needs the runtime/);
});

test("an attribute that stays as it is ends nothing, and none starts an element that left", async () => {
  const { login, tracks } = element({ authorize: () => new Promise(() => {}) });
  login.setAttribute("action", "enroll");
  login.button.click();
  await settled();
  login.setAttribute("action", "enroll");
  assert.deepEqual([tracks[0].stopped, login.button.textContent], [false, "Enroll"]);
  login.leave();
  login.setAttribute("action", "verify");
  await assert.rejects(login.attempt(), { name: "AbortError" });
});

test("a camera that ends is said and told, and ends the attempt", async () => {
  let signal;
  const fetch = (_, options) => {
    ({ signal } = options);
    return new Promise((_resolve, reject) => signal.addEventListener("abort", () => reject(signal.reason)));
  };
  const authorize = async () => ({ subject: "anna", token: `vft_${"a".repeat(20)}` });
  const { login, tracks, told } = element({ authorize, fetch });
  login.button.click();
  await settled();
  tracks[0].dispatchEvent(new Event("ended"));
  assert.deepEqual([signal.aborted, login.status.value], [true, login.words.camera]);
  assert.deepEqual([login.button.textContent, told.map(({ name }) => name)], ["Try again", ["NotReadableError"]]);
  login.button.click();
  await settled();
  tracks[0].dispatchEvent(new Event("ended"));
  assert.deepEqual([tracks[1].stopped, told.length], [false, 1], "the one before");
  login.leave();
});

test("the camera stays on only where another photo, or the passkey, may help", async () => {
  const { login, tracks, told } = element();
  const refused = (code, status) => new VeilfaceError(code, code, { status });
  for (const [error, stopped] of [
    [new VeilfaceError("no_face", "nobody"), false],
    [refused("low_quality", 422), false],
    [new VeilfaceError("inconsistent_images", "two"), false],
    [new VeilfaceError("passkey_refused", ""), false],
    [new VeilfaceError("passkey_unsupported", ""), true],
    [refused("forbidden", 403), true],
    [refused("locked_out", 423), true],
    [new VeilfaceError("unusable_contract", "not that of the contract"), true],
    [new TypeError("a defect"), true],
  ]) {
    login.attempt = async () => { throw error; };
    if (login.button.textContent !== "Log in") login.button.click();
    await settled();
    login.button.click();
    while (told.at(-1) !== error) await settled();
    assert.equal(tracks.at(-1).stopped, stopped, error.code ?? error.name);
  }
});

test("where the service checks liveness, private mode says that it cannot serve", async () => {
  const refusal = { error: { code: "forbidden", message: "liveness is asked for", details: { liveness: "active" } } };
  const fetch = async () => Response.json(refusal, { status: 403 });
  const authorize = async () => ({ subject: "anna", token: `vft_${"a".repeat(20)}` });
  const { login, told } = element({ authorize, fetch });
  login.button.click();
  await settled();
  login.button.click();
  while (told.length === 0) await settled();
  assert.match(login.status.value, /This page sends none/);
});
