// The camera, with live guidance: about one small frame a second is asked about, and slower where
// the service says so. The photos that count are taken at full size, a burst of three when the
// visitor says so, and each is asked about meanwhile.

import { faceBox, h } from "./dom.js";
import { Problem, call, crops, form, session } from "./service.js";
import { cameraTrouble, guidance, sentence } from "./words.js";

const EVERY_MS = 1000;
const FRAME = 480;
const PHOTO = 1280;
const QUALITY = 0.92;
// Apart enough for another moment of the face, and over before anyone moves.
const BURST = 3;
const APART_MS = 300;
const TAKE = `Take ${BURST} photos`;
const OFF = "The camera is off.";

// A picture of at most `side` pixels as JPEG, its middle square where that is asked for.
export async function picture(source, width, height, { side, quality = QUALITY, square = false }) {
  const [w, hgt] = square ? [Math.min(width, height), Math.min(width, height)] : [width, height];
  const scale = Math.min(1, side / Math.max(w, hgt));
  const canvas = h("canvas", { width: Math.round(w * scale), height: Math.round(hgt * scale) });
  canvas
    .getContext("2d")
    .drawImage(source, (width - w) / 2, (height - hgt) / 2, w, hgt, 0, 0, canvas.width, canvas.height);
  const blob = await new Promise((done) => canvas.toBlob(done, "image/jpeg", quality));
  // No blob: the picture is empty, or too large for the browser.
  if (!blob) throw new Problem({ code: "page_error", message: "the browser could not take a photo" });
  return { blob, width: canvas.width, height: canvas.height };
}

export const check = (blob, face, signal) =>
  session.mode?.active()
    ? session.mode.check(blob, face, signal)
    : call("POST", "/v1/photos/check", { body: form("image", [blob], { face }), signal });

// The service could not be asked; that says nothing of the photo.
export const unasked = ({ status, code }) =>
  code !== "page_error" && (!status || status === 429 || status >= 500);

export const after = (ms) => new Promise((done) => setTimeout(done, ms));

const release = (stream) => stream?.getTracks().forEach((each) => each.stop());

// The picture of the visitor's camera, mirrored, with what lies over it.
export function viewfinder(overlay) {
  const video = h("video", { playsinline: true, muted: true, "aria-label": "Your camera" });
  video.muted = true;
  const root = h("div", { class: "viewfinder", hidden: true }, video, overlay);
  return {
    root,
    // Runs until `signal` ends. `lost` is called where it is unplugged, forbidden, or taken by another program.
    async open(signal, lost) {
      let stream = null;
      signal.addEventListener("abort", () => {
        release(stream);
        video.srcObject = null;
        root.hidden = true;
      });
      try {
        if (!navigator.mediaDevices) throw new Error("insecure");
        stream = await navigator.mediaDevices.getUserMedia({
          audio: false,
          video: { facingMode: "user", width: { ideal: PHOTO } },
        });
      } catch (error) {
        throw new Problem({ code: "camera", message: cameraTrouble(error) });
      }
      // The view may have been left while the browser asked.
      if (signal.aborted) release(stream);
      signal.throwIfAborted();
      for (const track of stream.getVideoTracks()) {
        for (const name of ["ended", "mute"]) track.addEventListener(name, lost, { signal });
      }
      addEventListener("pagehide", lost, { signal });
      video.srcObject = stream;
      await video.play().catch(() => {});
      signal.throwIfAborted();
      root.hidden = false;
    },
    isOn: () => video.videoWidth > 0,
    shot: (options) => picture(video, video.videoWidth, video.videoHeight, options),
  };
}

// `onburst(photos)` gets the photos of a burst that would do, as {blob, name, seen}: `seen`
// is what the service saw, or null where it could not be asked; `face()` says which face counts.
export function camera({ onburst, face }) {
  const { overlay, mark } = faceBox();
  const finder = viewfinder(overlay);
  const said = h("p", { class: "guidance", role: "status", "data-state": "idle" }, OFF);
  const start = h("button", { type: "button", class: "secondary", onclick: begin }, "Start camera");
  const take = h("button", { type: "button", hidden: true, onclick: burst }, TAKE);
  const refused = h("p", { class: "refused", role: "status" });
  let running = new AbortController();

  function say(text, state) {
    // Only what changed is read out.
    if (said.textContent !== text) said.textContent = text;
    said.dataset.state = state;
  }

  async function begin() {
    running.abort();
    running = new AbortController();
    const { signal } = running;
    start.disabled = true;
    refused.textContent = "";
    try {
      await finder.open(signal, lost);
    } catch (error) {
      start.disabled = false;
      if (!signal.aborted) say(`${sentence(error.message)} You can also choose files.`, "bad");
      return;
    }
    take.hidden = false;
    start.hidden = true;
    take.focus();
    say("Looking for a face…", "idle");
    guide(signal);
  }

  async function guide(signal) {
    while (!signal.aborted) {
      const begun = Date.now();
      let pause = EVERY_MS;
      // Photos go first.
      if (!document.hidden && finder.isOn() && !take.matches(":disabled")) {
        try {
          const small = await snap(FRAME, 0.8);
          if (signal.aborted) return;
          const seen = await check(small.blob, face(), signal);
          if (signal.aborted) return;
          say(guidance(seen), seen.usable ? "good" : "bad");
          mark(seen.box, small.width, small.height);
        } catch (error) {
          if (signal.aborted) return;
          mark(null);
          const known = error instanceof Problem;
          pause = 1000 * Math.max(2, (known && error.wait) || 0);
          say(
            error.code === "rate_limited"
              ? "Guidance is paused: too many requests. You can still take a photo."
              : "Guidance is unavailable right now. You can still take a photo.",
            "idle",
          );
        }
      }
      await after(Math.max(250, pause - (Date.now() - begun)));
    }
  }

  // Packs without a detector take aligned crops, which are square.
  const snap = (side, quality) => finder.shot({ side, quality, square: crops() });

  // Why a photo would not do, or null.
  async function judge(photo, signal) {
    try {
      photo.seen = await check(photo.blob, face(), signal);
      return photo.seen.usable ? null : guidance(photo.seen);
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      return unasked(error) ? null : sentence(error.message);
    }
  }

  async function burst() {
    const { signal } = running;
    take.disabled = true;
    take.textContent = "Hold still…";
    refused.textContent = "";
    const good = [];
    let why = null;
    let judged = Promise.resolve();
    try {
      for (let shot = 0; shot < BURST; shot++) {
        if (shot) await after(APART_MS);
        if (signal.aborted) return;
        const photo = { blob: (await snap(PHOTO, QUALITY)).blob, name: "camera", seen: null };
        judged = judged.then(async () => {
          const not = await judge(photo, signal);
          if (not) why ??= not;
          else good.push(photo);
        });
        judged.catch(() => {});
      }
      await judged;
    } catch (error) {
      if (signal.aborted) return;
      if (!(error instanceof Problem)) throw error;
      why = sentence(error.message);
    } finally {
      take.disabled = false;
      take.textContent = TAKE;
    }
    if (signal.aborted) return;
    // Unless the visitor went on meanwhile; a button that is switched off loses the focus.
    if (document.activeElement === document.body) take.focus();
    if (why) refused.textContent = `${good.length || "None"} of ${BURST} photos taken. ${why}`;
    if (good.length) onburst(good);
  }

  function lost() {
    const focused = document.activeElement === take;
    running.abort();
    take.hidden = true;
    start.hidden = start.disabled = false;
    if (focused) start.focus();
    say("The camera has stopped. Start it again, or choose files.", "bad");
  }

  const root = h("div", { class: "camera" }, finder.root, said, h("div", { class: "row" }, start, take), refused);
  return { root, stop: () => running.abort() };
}
