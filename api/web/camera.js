// The camera, with live guidance: about one small frame a second is asked about, and slower where the service
// says so. The photos that count are taken at full size, a burst of three.

import { h } from "./dom.js";
import { Problem, call, form, session } from "./service.js";
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
  return blob;
}

export const check = (blob, face, signal) =>
  call("POST", "/v1/photos/check", { body: form("image", [blob], { face }), signal });

export const after = (ms) => new Promise((done) => setTimeout(done, ms));

const release = (stream) => stream?.getTracks().forEach((track) => track.stop());

// The picture of the visitor's camera, mirrored, in an outline for the face, with what lies over it.
export function viewfinder(...overlays) {
  const video = h("video", { playsinline: true, muted: true, hidden: true, "aria-label": "Your camera" });
  video.muted = true;
  const root = h("div", { class: "viewfinder" }, video, overlays);
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
    // A pack without a detector takes aligned crops, which are square.
    shot: (options) =>
      picture(video, video.videoWidth, video.videoHeight, { square: !session.contract.recorded.detector, ...options }),
  };
}

// `burst()` resolves to photos, as {blob, name}. `face()` says which face counts; `onchange` is called where the camera
// goes on or off.
export function camera({ face, onchange }) {
  const finder = viewfinder();
  const guide = h("p", { class: "guidance", role: "status", "data-state": "idle" }, "The camera is off.");
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
          const seen = await check(await finder.shot({ side: FRAME, quality: 0.8 }), face(), signal);
          if (signal.aborted) return;
          say(guidance(seen), seen.usable ? "good" : "bad");
        } catch (error) {
          if (signal.aborted) return;
          pause = 1000 * Math.max(2, (error instanceof Problem && error.retryAfter) || 0);
          say("Guidance is paused. You can still take a photo.", "idle");
        }
      }
      await after(Math.max(250, pause - (Date.now() - begun)));
    }
  }

  async function burst() {
    const { signal } = running;
    const photos = [];
    taking = true;
    say("Hold still…", "idle");
    try {
      for (let shot = 0; shot < BURST; shot++) {
        if (shot) await after(APART_MS);
        signal.throwIfAborted();
        photos.push({ blob: await finder.shot({ side: PHOTO }), name: "camera" });
      }
      say("Looking for a face…", "idle");
      return photos;
    } catch (error) {
      if (signal.aborted) return [];
      say(sentence(error.message), "bad");
      return [];
    } finally {
      taking = false;
    }
  }

  function lost() {
    running.abort();
    say("The camera has stopped. Start it again, or choose files.", "bad");
    onchange();
  }

  finder.root.append(guide);
  return { root: finder.root, begin, burst, isOn: () => !running.signal.aborted && finder.isOn(), stop: () => running.abort() };
}
