/** `<veilface-login>`: camera, burst or head movements, decision, for any page. */

import { FaceError } from "../models/errors.js";
import { fromImageData, type RgbImage } from "../models/image.js";
import type { FacePolicy } from "../models/selection.js";
import type { Decision, Enrollment } from "../service/answers.js";
import { Client } from "../service/client.js";
import { ContractMismatch, PhotoRefused } from "../service/errors.js";
import { Enrollable, type Probe } from "../service/lifts.js";
import { PrivateClient, type PrivateOptions } from "../service/private-client.js";
import { InconsistentImages } from "../templates/errors.js";
import { createPasskey, passkeyHolderKey, PasskeyError, type Passkey } from "./passkey.js";

export { PasskeyError } from "./passkey.js";

/** What the page's server says when a person wants to log in: whose token it is, and the token. */
export interface Authorization {
  readonly subject: string;
  readonly token: string;
  /** In the place of a key from a passkey. */
  readonly holderKey?: Uint8Array;
}

/** Of `PrivateClient`; a verification that sends frames needs no runtime. */
export type LoginOptions = Omit<PrivateOptions, "signal" | "runtime"> &
  Partial<Pick<PrivateOptions, "runtime">>;

/** What the element says to the person. */
export interface Words {
  readonly start: string;
  readonly take: string;
  readonly enroll: string;
  readonly waiting: string;
  readonly working: string;
  readonly passkey: string;
  readonly accept: string;
  readonly reject: string;
  readonly enrolled: string;
  readonly camera: string;
  /** What a screen reader calls the picture of the camera. */
  readonly video: string;
  /** Shown as long as verifications send photos, so before the camera starts. */
  readonly frames: string;
  /** By their names in a challenge, and `front` and `move_back`. */
  readonly movements: Readonly<Record<string, string>>;
  readonly notLive: string;
  /** The service asks for liveness, and the page for none. */
  readonly liveness: string;
  /** By an error's `code`, or its `name` where it has none; the error's message for all others. */
  readonly errors: Readonly<Record<string, string>>;
}

/** The texts in English; give others for another language. */
export const WORDS: Words = {
  start: "Start camera",
  take: "Log in",
  enroll: "Enroll",
  waiting: "Look into the camera.",
  working: "One moment …",
  passkey: "Use your passkey.",
  accept: "Welcome.",
  reject: "That did not match. Try again.",
  enrolled: "You are enrolled.",
  camera: "The camera cannot be used.",
  video: "Your camera",
  frames:
    "To log in, move your head as you are asked to, for about 12 seconds. Photos of that are sent to the service.",
  movements: {
    front: "Look straight ahead.",
    move_back: "Move back and look straight ahead.",
    turn_left: "Turn your head to the left.",
    turn_right: "Turn your head to the right.",
    look_up: "Look up.",
    look_down: "Look down.",
    come_closer: "Come closer.",
  },
  notLive: "The movements were not seen. Follow each of them, in good light.",
  liveness: "This service checks that a face is live, which takes photos. This page sends none.",
  errors: {},
};

const STYLE = `
:host { display: inline-block; font: inherit; max-width: 100%; }
video { display: block; width: var(--veilface-width, 20rem); max-width: 100%; aspect-ratio: 4 / 3;
  background: var(--veilface-background, #222); object-fit: cover; transform: scaleX(-1); }
button { font: inherit; margin: 0.5rem 0; }
output { display: block; min-height: 1.5em; }
p { margin: 0.5rem 0; }
p:empty { display: none; }
`;

const BURST = 3;
const BETWEEN_FRAMES = 150; // milliseconds, so that the frames are not one picture three times
// Of a movement, as on the service's own page: two frames on the way out, one back at the front.
const READY = 2500;
const OUT = [1200, 600];
const BACK = 1300;

const after = (milliseconds: number): Promise<void> =>
  new Promise((resolve) => setTimeout(resolve, milliseconds));

/** Another photo may help, or the passkey after all; for all else no camera is needed. */
const mendable = (error: unknown): boolean =>
  error instanceof FaceError ||
  error instanceof InconsistentImages ||
  error instanceof PhotoRefused ||
  (error instanceof PasskeyError && error.code === "passkey_refused");

// A server that renders pages imports this module too, and has no elements.
const Base = globalThis.HTMLElement ?? (class {} as typeof HTMLElement);

/**
 * The element. Set `options` and `authorize`; then it asks for the camera when it is told to, takes
 * a burst, lifts it in the page, sends the template alone, and tells the page by an event:
 * `veilface-result` with the decision (or enrollment) as its detail, `veilface-error` with the error.
 *
 * The attribute `service` is the service's URL, by default the page's own origin; `action` is
 * `verify` (by default) or `enroll`; `face` is a {@link FacePolicy}, by default `dominant`. With the attribute `passkey` an enrollment makes one and is locked to the key that it gives,
 * and a verification asks for it. Parts for styling: `notice`, `video`, `button`, `status`.
 *
 * With `liveness="head-movements"` a verification sends no private template: it answers a challenge, by
 * frames that are sent as photos, and `words.frames` says so. An enrollment stays private.
 *
 * Taken out of the page it stops the camera and ends the attempt: nothing more is sent or told.
 *
 * Never believe the event alone: your server asks the service what came of the token.
 */
export class VeilfaceLogin extends Base {
  static readonly observedAttributes = ["liveness", "action"];

  // Declared and not defined: a page may have set them before its element was known.
  /** Of `PrivateClient`: the ONNX Runtime, and where the graphs are. */
  declare options: LoginOptions | undefined;
  /**
   * Asks your server for a token, which is good for one call and for minutes: called once to fetch
   * the graphs, which may take longer than that, and once for each attempt. Where frames are sent, it is
   * called once, before the movements.
   */
  declare authorize: (() => Promise<Authorization>) | undefined;

  #words = WORDS;
  readonly #notice = document.createElement("p");
  readonly #video = document.createElement("video");
  readonly #button = document.createElement("button");
  readonly #status = document.createElement("output");
  #camera: MediaStream | undefined;
  // Graphs stay loaded from one attempt to the next.
  #client: Promise<PrivateClient> | undefined;
  // Another attempt to enroll takes the same passkey.
  #passkey: Passkey | undefined;
  // Aborted when the element leaves the page; another one when it comes back.
  #stay = new AbortController();

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    // A constructed sheet needs no `unsafe-inline` of the page.
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(STYLE);
    root.adoptedStyleSheets = [sheet];
    this.#video.muted = true;
    this.#video.playsInline = true;
    this.#notice.part.add("notice");
    this.#notice.id = "notice";
    this.#video.part.add("video");
    this.#button.type = "button";
    this.#button.setAttribute("aria-describedby", this.#notice.id);
    this.#button.part.add("button");
    this.#status.part.add("status");
    root.append(this.#notice, this.#video, this.#button, this.#status);
    this.#button.addEventListener("click", () => void this.#clicked());
    if (Object.hasOwn(this, "words")) {
      const { words } = this;
      // It hides the accessor.
      Reflect.deleteProperty(this, "words");
      this.words = words;
    }
  }

  /** What the element says; of what is set, what is missing is in English. */
  get words(): Words {
    return this.#words;
  }

  set words(given: Partial<Words>) {
    const movements = { ...WORDS.movements, ...given.movements };
    this.#words = { ...WORDS, ...given, movements };
    this.#show();
  }

  connectedCallback(): void {
    if (this.#stay.signal.aborted) this.#stay = new AbortController();
    this.#show();
  }

  /** What is sent changes: the camera starts again once the person has read it. */
  attributeChangedCallback(_: string, old: string | null, now: string | null): void {
    if (old !== now && this.isConnected) this.#restart();
  }

  #restart(): void {
    this.disconnectedCallback();
    this.connectedCallback();
  }

  /** What is on the page whatever the person does: the button's text, what is sent, the video's name. */
  #show(): void {
    const { start, take, enroll, frames, video } = this.words;
    this.#button.textContent =
      this.#camera === undefined ? start : this.#enrolls ? enroll : take;
    this.#notice.textContent = this.#sendsFrames ? frames : "";
    this.#video.setAttribute("aria-label", video);
  }

  disconnectedCallback(): void {
    this.#stay.abort();
    this.#stop();
    this.#say("");
    void this.#forgetClient();
  }

  async #forgetClient(): Promise<void> {
    const client = this.#client;
    this.#client = undefined;
    await client?.then((each) => each.close()).catch(() => undefined);
  }

  get #sendsFrames(): boolean {
    return this.getAttribute("liveness") === "head-movements" && !this.#enrolls;
  }

  get #enrolls(): boolean {
    return this.getAttribute("action") === "enroll";
  }

  get #face(): FacePolicy {
    const face = this.getAttribute("face");
    return face === "largest" || face === "single" ? face : "dominant";
  }

  /**
   * Take a burst, lift and send it, or answer a challenge; the decision (or enrollment) also comes
   * as an event.
   */
  async attempt(): Promise<Decision | Enrollment> {
    const { signal } = this.#stay;
    this.#given();
    signal.throwIfAborted();
    if (this.#sendsFrames) return this.#challenged(signal);
    const photos = await this.#burst(signal);
    const lift = await this.#lifted(photos, signal);
    try {
      return await this.#send(lift, signal);
    } catch (error) {
      if (!(error instanceof ContractMismatch)) throw error;
      signal.throwIfAborted();
      await this.#forgetClient();
      const again = await this.#lifted(photos, signal);
      // Else it is the person's stored template that is of another contract.
      if (again.contractId === lift.contractId) throw error;
      return this.#send(again, signal);
    }
  }

  /** Before a token or a passkey is asked for: the photos may not do. */
  async #lifted(photos: RgbImage[], signal: AbortSignal): Promise<Enrollable | Probe> {
    const client = await this.#prepared(signal);
    signal.throwIfAborted();
    const face = this.#face;
    return this.#enrolls ? client.liftEnrollment(photos, { face }) : client.lift(photos, { face });
  }

  /**
   * Say the movements by the clock, and send the frames that were taken meanwhile.
   *
   * It does not wait until it sees one: a recording that shows all in turn would be waited for, too.
   */
  async #challenged(signal: AbortSignal): Promise<Decision> {
    const { options, authorize } = this.#given();
    if (!this.words.frames?.trim()) {
      throw new Error("<veilface-login> sends no photo where words.frames does not say so");
    }
    const { subject, token, ...given } = await authorize();
    signal.throwIfAborted();
    const holderKey = given.holderKey ?? (await this.#holderKey(subject, false, signal));
    const client = new Client(this.#url, token, { ...options, signal });
    const ask = (movement: string): void => {
      signal.throwIfAborted();
      this.#say(this.words.movements[movement] ?? movement);
    };
    const snap = async (wait = 0): Promise<Blob> => {
      await after(wait);
      return this.#drawn(signal).canvas.convertToBlob({ type: "image/jpeg", quality: 0.92 });
    };
    // A screen reader says each at once, for the clock does not wait.
    this.#status.setAttribute("aria-live", "assertive");
    try {
      ask("front");
      await after(READY);
      // Asked for now: its minute begins.
      const challenge = await client.challenge(subject);
      const frames = [await snap()];
      for (const movement of challenge.movements) {
        ask(movement);
        for (const wait of OUT) frames.push(await snap(wait));
        ask(movement === "come_closer" ? "move_back" : "front");
        frames.push(await snap(BACK));
      }
      signal.throwIfAborted();
      this.#say(this.words.working);
      const more = { challenge, face: this.#face };
      return await client.verify(subject, frames, holderKey ? { ...more, holderKey } : more);
    } finally {
      this.#status.setAttribute("aria-live", "polite");
    }
  }

  async #send(lift: Enrollable | Probe, signal: AbortSignal): Promise<Decision | Enrollment> {
    const { authorize } = this.#given();
    const prepared = await this.#prepared(signal);
    signal.throwIfAborted();
    const { subject, token, ...given } = await authorize();
    signal.throwIfAborted();
    const holderKey =
      given.holderKey ?? (await this.#holderKey(subject, lift instanceof Enrollable, signal));
    signal.throwIfAborted();
    const client = prepared.as(token);
    try {
      const more = holderKey && { holderKey };
      const result = await (lift instanceof Enrollable
        ? client.enroll(subject, lift, more)
        : client.verify(subject, lift, more));
      signal.throwIfAborted();
      return result;
    } finally {
      await client.close();
    }
  }

  /** The key of the person's passkey, where one is to be asked for. */
  async #holderKey(
    subject: string,
    enrolls: boolean,
    signal: AbortSignal,
  ): Promise<Uint8Array | undefined> {
    if (this.getAttribute("passkey") === null) return undefined;
    this.#say(this.words.passkey);
    if (enrolls && this.#passkey?.subject !== subject) {
      this.#passkey = await createPasskey(subject, signal);
    }
    try {
      const key = await passkeyHolderKey(subject, signal, enrolls ? this.#passkey : undefined);
      this.#say(this.words.working);
      return key;
    } catch (error) {
      // It will not do the next time either.
      if (error instanceof PasskeyError && error.code === "passkey_unsupported") {
        this.#passkey = undefined;
      }
      throw error;
    }
  }

  get #url(): string {
    return this.getAttribute("service") ?? location.origin;
  }

  #given(): { options: LoginOptions; authorize: () => Promise<Authorization> } {
    const { options = {}, authorize } = this;
    if (authorize === undefined) throw new Error("<veilface-login> needs its property authorize");
    return { options, authorize };
  }

  /** The client whose graphs are loaded, or will be; what failed is tried again the next time. */
  #prepared(signal: AbortSignal): Promise<PrivateClient> {
    if (this.#client === undefined) {
      const client: Promise<PrivateClient> = this.#prepare(signal).catch((error: unknown) => {
        if (this.#client === client) this.#client = undefined;
        throw error;
      });
      this.#client = client;
    }
    return this.#client;
  }

  async #prepare(signal: AbortSignal): Promise<PrivateClient> {
    const { options, authorize } = this.#given();
    const { runtime } = options;
    if (runtime === undefined) throw new Error("<veilface-login> needs the runtime in its options");
    const { token } = await authorize();
    signal.throwIfAborted();
    const client = new PrivateClient(this.#url, token, { ...options, runtime, signal });
    try {
      await client.prepare();
      signal.throwIfAborted();
      return client;
    } catch (error) {
      await client.close();
      throw error;
    }
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
    const { signal } = this.#stay;
    try {
      const camera = await navigator.mediaDevices.getUserMedia({
        video: { facingMode: "user", width: { ideal: 640 }, height: { ideal: 480 } },
      });
      // The person may have left while the browser asked them.
      if (signal.aborted) {
        camera.getTracks().forEach((track) => track.stop());
        return;
      }
      this.#camera = camera;
      for (const track of camera.getTracks()) {
        track.addEventListener("ended", () => this.#ended(camera));
      }
      this.#video.srcObject = camera;
      await this.#video.play();
      if (signal.aborted) return;
    } catch (error) {
      if (signal.aborted) return;
      this.#stop();
      this.#say(this.words.camera);
      this.#tell("veilface-error", error);
      return;
    }
    this.#show();
    this.#say(this.words.waiting);
    if (this.#sendsFrames) return;
    // While the person looks; the attempt waits for it, and tells what went wrong.
    this.#prepared(signal).catch(() => undefined);
  }

  async #try(): Promise<void> {
    const { signal } = this.#stay;
    this.#say(this.words.working);
    try {
      const result = await this.attempt();
      if (signal.aborted) return;
      this.#stop();
      const { accept, reject, notLive, enrolled } = this.words;
      if (!("accepted" in result)) this.#say(enrolled);
      else if (result.accepted) this.#say(accept);
      else this.#say(result.reason === "liveness" ? notLive : reject);
      this.#tell("veilface-result", result);
    } catch (error) {
      if (signal.aborted) return;
      if (!mendable(error)) this.#stop();
      this.#say(this.#wordsOf(error));
      this.#tell("veilface-error", error);
    }
  }

  /** The frames of a moment, as the camera gives them, not mirrored. */
  async #burst(signal: AbortSignal): Promise<RgbImage[]> {
    const photos: RgbImage[] = [];
    for (let frame = 0; frame < BURST; frame++) {
      if (frame > 0) await after(BETWEEN_FRAMES);
      const context = this.#drawn(signal);
      const { width, height } = context.canvas;
      photos.push(fromImageData(context.getImageData(0, 0, width, height)));
    }
    return photos;
  }

  /** What the camera shows now. */
  #drawn(signal: AbortSignal): OffscreenCanvasRenderingContext2D {
    signal.throwIfAborted();
    const { videoWidth: width, videoHeight: height } = this.#video;
    const context = new OffscreenCanvas(width, height).getContext("2d", {
      willReadFrequently: true,
    });
    if (context === null) throw new Error("this browser gives no canvas to take photos with");
    context.drawImage(this.#video, 0, 0);
    return context;
  }

  /** It was unplugged, forbidden, or taken by another program. */
  #ended(camera: MediaStream): void {
    if (this.#camera !== camera) return;
    this.#restart();
    this.#say(this.words.camera);
    this.#tell("veilface-error", new DOMException("the camera has stopped", "NotReadableError"));
  }

  #stop(): void {
    this.#camera?.getTracks().forEach((track) => track.stop());
    this.#camera = undefined;
    this.#video.srcObject = null;
    this.#show();
  }

  #wordsOf(error: unknown): string {
    if (!(error instanceof Error)) return String(error);
    const { code, details, name } = error as Error & { code?: unknown; details?: { liveness?: string } };
    if (details?.liveness !== undefined && !this.#sendsFrames) return this.words.liveness;
    const key = typeof code === "string" ? code : name;
    return Object.hasOwn(this.words.errors, key) ? this.words.errors[key] : error.message;
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
