// The camera, with live guidance: about one small frame a second is asked about, and slower where the service
// says so. The photos that count are taken at full size, a burst of three, and each is asked about meanwhile.

import { faceBox, h, s } from "./dom.js";
import { Problem, call, crops, form, session } from "./service.js";
import { cameraTrouble, guidance, sentence } from "./words.js";

const EVERY_MS = 1000;
const FRAME = 480;
const PHOTO = 1280;
const QUALITY = 0.92;
export const BURST = 3;
// Apart enough for another moment of the face, and over before anyone moves.
const APART_MS = 300;

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
export const unasked = ({ status, code }) => code !== "page_error" && (!status || status === 429 || status >= 500);

export const after = (ms) => new Promise((done) => setTimeout(done, ms));

const release = (stream) => stream?.getTracks().forEach((track) => track.stop());

// The picture of the visitor's camera, mirrored, in an outline for the face, with what lies over it.
export function viewfinder(...overlays) {
  const video = h("video", { playsinline: true, muted: true, hidden: true, "aria-label": "Your camera" });
  video.muted = true;
  const outline = s("ellipse", { class: "outline", cx: "50", cy: "50", rx: "21", ry: "38" });
  const shape = { class: "overlay", viewBox: "0 0 100 100", preserveAspectRatio: "none", "aria-hidden": "true" };
  const root = h("div", { class: "viewfinder" }, video, s("svg", shape, outline), overlays);
  return {
    root,
    // Runs until `signal` ends. `lost` is called where it is unplugged, forbidden, or taken by another program.
    async open(signal, lost) {
      let stream = null;
      signal.addEventListener("abort", () => {
        release(stream);
        video.srcObject = null;
        video.hidden = true;
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
      video.hidden = false;
    },
    isOn: () => video.videoWidth > 0 && !video.hidden,
    shot: (options) => picture(video, video.videoWidth, video.videoHeight, options),
  };
}

// `burst()` resolves to the photos that would do, as {blob, name, seen}: `seen` is what the service saw, or null where
// it could not be asked. `face()` says which face counts; `onchange` is called where the camera goes on or off.
export function camera({ face, onchange }) {
  const { overlay, mark } = faceBox();
  const finder = viewfinder(overlay);
  const guide = h("p", { class: "guidance", role: "status", "data-state": "idle" }, "The camera is off.");
  const refused = h("p", { class: "refused", role: "status" });
  let running = new AbortController();
  running.abort();
  let taking = false;

  function say(text, state) {
    // Only what changed is read out.
    if (guide.textContent !== text) guide.textContent = text;
    guide.dataset.state = state;
  }

  async function begin() {
    running.abort();
    running = new AbortController();
    const { signal } = running;
    refused.textContent = "";
    try {
      await finder.open(signal, lost);
    } catch (error) {
      if (!signal.aborted) say(`${sentence(error.message)} You can also choose files.`, "bad");
      return;
    }
    say("Looking for a face…", "idle");
    onchange();
    look(signal);
  }

  async function look(signal) {
    while (!signal.aborted) {
      const begun = Date.now();
      let pause = EVERY_MS;
      // Photos go first.
      if (!document.hidden && finder.isOn() && !taking && !guide.closest("fieldset:disabled")) {
        try {
          const small = await snap(FRAME, 0.8);
          const seen = await check(small.blob, face(), signal);
          if (signal.aborted) return;
          say(guidance(seen), seen.usable ? "good" : "bad");
          mark(seen.box, small.width, small.height);
        } catch (error) {
          if (signal.aborted) return;
          mark(null);
          pause = 1000 * Math.max(2, (error instanceof Problem && error.wait) || 0);
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
    taking = true;
    refused.textContent = "";
    say("Hold still…", "idle");
    const good = [];
    let why = null;
    try {
      const judged = [];
      for (let shot = 0; shot < BURST; shot++) {
        if (shot) await after(APART_MS);
        signal.throwIfAborted();
        const photo = { blob: (await snap(PHOTO, QUALITY)).blob, name: "camera", seen: null };
        const before = judged.at(-1);
        judged.push(Promise.resolve(before).then(() => judge(photo, signal)).then((reason) => {
          if (reason) why ??= reason;
          else good.push(photo);
        }));
      }
      await Promise.all(judged);
    } catch (error) {
      if (!signal.aborted && !(error instanceof Problem)) throw error;
      why = sentence(error.message);
    } finally {
      taking = false;
    }
    if (signal.aborted) return [];
    say(why ? "Looking for a face…" : "Photos taken.", "idle");
    if (why) refused.textContent = `${good.length || "None"} of ${BURST} photos taken. ${why}`;
    return good;
  }

  function lost() {
    running.abort();
    say("The camera has stopped. Start it again, or choose files.", "bad");
    onchange();
  }

  finder.root.append(guide);
  const root = h("div", { class: "camera" }, finder.root, refused);
  return { root, begin, burst, isOn: () => !running.signal.aborted && finder.isOn(), stop: () => running.abort() };
}
