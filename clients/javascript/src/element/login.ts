/** `<veilface-login>`: camera, burst, private template, decision, for any page. */

import { fromImageData, type RgbImage } from "../models/image.js";
import type { Decision, Enrollment } from "../service/answers.js";
import { PrivateClient, type PrivateOptions } from "../service/private-client.js";

/** What the page's server says when a person wants to log in: whose token it is, and the token. */
export interface Authorization {
  readonly subject: string;
  readonly token: string;
  readonly holderKey?: Uint8Array;
}

/** What the element says to the person; give others for another language. */
export const WORDS = {
  start: "Start camera",
  take: "Log in",
  enroll: "Enroll",
  waiting: "Look into the camera.",
  working: "One moment …",
  accept: "Welcome.",
  reject: "That did not match. Try again.",
  enrolled: "You are enrolled.",
  camera: "The camera cannot be used.",
};

const STYLE = `
:host { display: inline-block; font: inherit; max-width: 100%; }
video { display: block; width: var(--veilface-width, 20rem); max-width: 100%; aspect-ratio: 4 / 3;
  background: var(--veilface-background, #222); object-fit: cover; transform: scaleX(-1); }
button { font: inherit; margin: 0.5rem 0; }
output { display: block; min-height: 1.5em; }
`;

const BURST = 3;
const BETWEEN_FRAMES = 150; // milliseconds, so that the frames are not one picture three times

/**
 * The element. Set `runtime` and `authorize`; then it asks for the camera when it is told to, takes
 * a burst, lifts it in the page, sends the template alone, and tells the page by an event:
 * `veilface-result` with the decision (or enrollment) as its detail, `veilface-error` with the error.
 *
 * The attribute `service` is the service's URL, by default the page's own origin; `action` is
 * `verify` (by default) or `enroll`. Parts for styling: `video`, `button`, `status`.
 *
 * Never believe the event alone: your server asks the service what came of the token.
 */
export class VeilfaceLogin extends HTMLElement {
  /** Of `PrivateClient`: the ONNX Runtime, and where the graphs are. */
  options: PrivateOptions | undefined;
  /** Asks your server for a token; called for each attempt, because a token is good for one. */
  authorize: (() => Promise<Authorization>) | undefined;
  words = WORDS;

  readonly #video = document.createElement("video");
  readonly #button = document.createElement("button");
  readonly #status = document.createElement("output");
  #camera: MediaStream | undefined;
  // Graphs stay loaded from one attempt to the next.
  #client: PrivateClient | undefined;

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    // A constructed sheet needs no `unsafe-inline` of the page.
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(STYLE);
    root.adoptedStyleSheets = [sheet];
    this.#video.muted = true;
    this.#video.playsInline = true;
    this.#video.part.add("video");
    this.#button.type = "button";
    this.#button.part.add("button");
    this.#status.part.add("status");
    root.append(this.#video, this.#button, this.#status);
    this.#button.addEventListener("click", () => void this.#clicked());
  }

  connectedCallback(): void {
    this.#button.textContent = this.words.start;
  }

  disconnectedCallback(): void {
    this.#stop();
    void this.#client?.close();
    this.#client = undefined;
  }

  /** Take a burst, lift and send it; the decision (or enrollment) also comes as an event. */
  async attempt(): Promise<Decision | Enrollment> {
    const { options, authorize } = this;
    if (options === undefined || authorize === undefined) {
      throw new Error("<veilface-login> needs its properties options and authorize");
    }
    const photos = await this.#burst();
    const { subject, token, holderKey } = await authorize();
    const url = this.getAttribute("service") ?? location.origin;
    const client = this.#client?.as(token) ?? new PrivateClient(url, token, options);
    this.#client = client;
    const more = { face: "largest", ...(holderKey && { holderKey }) } as const;
    return this.getAttribute("action") === "enroll"
      ? client.enroll(subject, photos, more)
      : client.verify(subject, photos, more);
  }

  async #clicked(): Promise<void> {
    this.#button.disabled = true;
    try {
      if (this.#camera === undefined) await this.#start();
      else await this.#try();
    } finally {
      this.#button.disabled = false;
    }
  }

  async #start(): Promise<void> {
    try {
      this.#camera = await navigator.mediaDevices.getUserMedia({
        video: { facingMode: "user", width: { ideal: 640 }, height: { ideal: 480 } },
      });
      this.#video.srcObject = this.#camera;
      await this.#video.play();
    } catch (error) {
      this.#say(this.words.camera);
      this.#tell("veilface-error", error);
      return;
    }
    const enrolls = this.getAttribute("action") === "enroll";
    this.#button.textContent = enrolls ? this.words.enroll : this.words.take;
    this.#say(this.words.waiting);
  }

  async #try(): Promise<void> {
    this.#say(this.words.working);
    try {
      const result = await this.attempt();
      this.#stop();
      if ("accepted" in result) this.#say(result.accepted ? this.words.accept : this.words.reject);
      else this.#say(this.words.enrolled);
      this.#tell("veilface-result", result);
    } catch (error) {
      this.#say(error instanceof Error ? error.message : String(error));
      this.#tell("veilface-error", error);
    }
  }

  /** The frames of a moment, as the camera gives them, not mirrored. */
  async #burst(): Promise<RgbImage[]> {
    const { videoWidth: width, videoHeight: height } = this.#video;
    const context = new OffscreenCanvas(width, height).getContext("2d", {
      willReadFrequently: true,
    });
    if (context === null) throw new Error("this browser gives no canvas to take photos with");
    const photos: RgbImage[] = [];
    for (let frame = 0; frame < BURST; frame++) {
      if (frame > 0) await new Promise((resolve) => setTimeout(resolve, BETWEEN_FRAMES));
      context.drawImage(this.#video, 0, 0);
      photos.push(fromImageData(context.getImageData(0, 0, width, height)));
    }
    return photos;
  }

  #stop(): void {
    this.#camera?.getTracks().forEach((track) => track.stop());
    this.#camera = undefined;
    this.#video.srcObject = null;
    this.#button.textContent = this.words.start;
  }

  #say(text: string): void {
    this.#status.value = text;
  }

  #tell(event: string, detail: unknown): void {
    this.dispatchEvent(new CustomEvent(event, { detail, bubbles: true, composed: true }));
  }
}

/** Make the element known to the page. */
export function defineLogin(name = "veilface-login"): void {
  if (customElements.get(name) === undefined) customElements.define(name, VeilfaceLogin);
}
