/** `<veilface-login>`: camera, burst, decision, for any page. */

import type { Decision, Enrollment } from "../answers.js";
import { isPhotoRefused, VeilfaceError } from "../errors.js";
import type { FacePolicy } from "../models/faces.js";
import { drawn, type RgbImage } from "../models/image.js";
import { createPasskey, passkeyHolderKey, type Passkey } from "../service/passkey.js";
import { PrivateClient, type PrivateOptions } from "../service/private-client.js";
import { STYLE, type State } from "./look.js";
import { withDefaults, type Words } from "./words.js";

export { VeilfaceError } from "../errors.js";
export { WORDS, type Words } from "./words.js";

/** What the page's server says when a person wants to log in: whose token it is, and the token. */
export interface Authorization {
  readonly subject: string;
  readonly token: string;
}

/** Of `PrivateClient`. */
export type LoginOptions = Omit<PrivateOptions, "signal">;

const BURST = 3;
const BETWEEN_FRAMES = 150; // milliseconds, so that the frames are not one picture three times
const BETWEEN_LOOKS = 600;
// What went wrong is left to be read before guidance goes on.
const READING = 5000;

const after = (milliseconds: number): Promise<void> =>
  new Promise((resolve) => setTimeout(resolve, milliseconds));

const codeOf = (error: unknown): string | undefined =>
  error instanceof VeilfaceError ? error.code : undefined;

/** Another photo may help, or the passkey after all; for all else no camera is needed. */
const isMendable = (error: unknown): boolean =>
  isPhotoRefused(error) || codeOf(error) === "passkey_refused";

// A server that renders pages imports this module too, and has no elements.
const Base = globalThis.HTMLElement ?? (class {} as typeof HTMLElement);

/**
 * The element. Set `options` and `authorize`; then it asks for the camera when the person starts it,
 * says how the face is to be held, takes a burst, lifts it in the page, sends the template alone, and
 * tells the page by an event: `veilface-result` with the decision (or enrollment) as its detail,
 * `veilface-error` with the error.
 *
 * The attribute `service` is the service's URL, by default the page's own origin; `action` is
 * `verify` (by default) or `enroll`; `face` is a {@link FacePolicy}, by default `dominant`. With the
 * attribute `passkey` an enrollment makes one and is locked to the key that it gives, and a
 * verification asks for it. Parts for styling: `card`, `viewfinder`, `video`, `status`, `button`.
 *
 * Taken out of the page it stops the camera and ends the attempt: nothing more is sent or told.
 *
 * Never believe the event alone: your server asks the service what came of the token.
 */
export class VeilfaceLogin extends Base {
  static readonly observedAttributes = ["action"];

  // Declared and not defined: a page may have set them before its element was known.
  /** Of `PrivateClient`: the ONNX Runtime, and where the graphs are. */
  declare options: LoginOptions | undefined;
  /**
   * Asks your server for a token, which is good for one call and for minutes: called once to fetch
   * the graphs, which may take longer than that, and once for each attempt.
   */
  declare authorize: (() => Promise<Authorization>) | undefined;

  #words = withDefaults({});
  readonly #card = part("section", "card");
  readonly #video = part("video", "video");
  readonly #status = part("output", "status");
  readonly #button = part("button", "button");
  #state: State = "off";
  #quietUntil = 0;
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
    this.#button.type = "button";
    this.#button.addEventListener("click", () => void this.#clicked());
    const viewfinder = part("div", "viewfinder");
    viewfinder.append(this.#video);
    this.#card.append(viewfinder, this.#status, this.#button);
    root.append(this.#card);
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
    this.#words = withDefaults(given);
    this.#show();
  }

  connectedCallback(): void {
    if (this.#stay.signal.aborted) this.#stay = new AbortController();
    this.#show();
  }

  disconnectedCallback(): void {
    this.#stay.abort();
    this.#stop();
    this.#enter("off", "");
    void this.#forgetClient();
  }

  /** What is done changes: the camera starts again. */
  attributeChangedCallback(_: string, old: string | null, now: string | null): void {
    if (old !== now && this.isConnected) this.reset();
  }

  /** Go back to the start, from whatever goes on: the camera is off, and nothing is said. */
  reset(): void {
    this.disconnectedCallback();
    this.connectedCallback();
  }

  get #enrolls(): boolean {
    return this.getAttribute("action") === "enroll";
  }

  get #face(): FacePolicy {
    const face = this.getAttribute("face");
    return face === "largest" || face === "single" ? face : "dominant";
  }

  get #url(): string {
    return this.getAttribute("service") ?? location.origin;
  }

  /** Take a burst, lift and send it; the decision (or enrollment) also comes as an event. */
  async attempt(): Promise<Decision | Enrollment> {
    const { signal } = this.#stay;
    this.#given();
    signal.throwIfAborted();
    this.#enter("busy", this.words.hold);
    const photos = await this.#burst(signal);
    this.#enter("busy", this.words.working);
    try {
      const client = await this.#prepared(signal);
      signal.throwIfAborted();
      // Before a token or a passkey is asked for: the photos may not do.
      const given = { face: this.#face };
      const enrolls = this.#enrolls;
      const lift = await (enrolls ? client.liftEnrollment(photos, given) : client.lift(photos, given));
      signal.throwIfAborted();
      const { subject, token } = await this.#given().authorize();
      signal.throwIfAborted();
      const holderKey = await this.#holderKey(subject, enrolls, signal);
      signal.throwIfAborted();
      const options = { token, ...(holderKey && { holderKey }) };
      const result = await (enrolls ? client.enroll(subject, lift, options) : client.verify(subject, lift, options));
      signal.throwIfAborted();
      return result;
    } catch (error) {
      // The next attempt is of the contract in force.
      if (codeOf(error) === "contract_mismatch") await this.#forgetClient();
      throw error;
    }
  }

  /** The key of the person's passkey, where one is to be asked for. */
  async #holderKey(subject: string, enrolls: boolean, signal: AbortSignal): Promise<Uint8Array | undefined> {
    if (this.getAttribute("passkey") === null) return undefined;
    this.#enter("busy", this.words.passkey);
    if (enrolls && this.#passkey?.subject !== subject) {
      this.#passkey = await createPasskey(subject, signal);
    }
    try {
      const key = await passkeyHolderKey(subject, signal, enrolls ? this.#passkey : undefined);
      this.#enter("busy", this.words.working);
      return key;
    } catch (error) {
      // It will not do the next time either.
      if (codeOf(error) === "passkey_unsupported") this.#passkey = undefined;
      throw error;
    }
  }

  #given(): { options: LoginOptions; authorize: () => Promise<Authorization> } {
    const { options, authorize } = this;
    if (authorize === undefined) throw new Error("<veilface-login> needs its property authorize");
    if (options?.runtime === undefined) throw new Error("<veilface-login> needs the runtime in its options");
    return { options, authorize };
  }

  /** The client whose graphs are loaded, or will be; what failed is tried again the next time. */
  #prepared(signal: AbortSignal): Promise<PrivateClient> {
    this.#client ??= this.#prepare(signal).catch((error: unknown) => {
      if (!signal.aborted) this.#client = undefined;
      throw error;
    });
    return this.#client;
  }

  async #prepare(signal: AbortSignal): Promise<PrivateClient> {
    const { options, authorize } = this.#given();
    const { token } = await authorize();
    signal.throwIfAborted();
    const client = new PrivateClient(this.#url, token, { ...options, signal });
    await client.prepare();
    return client;
  }

  async #forgetClient(): Promise<void> {
    const client = this.#client;
    this.#client = undefined;
    await client?.then((each) => each.close()).catch(() => undefined);
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
      this.#enter("searching", this.words.waiting);
      void this.#guide(camera, signal);
    } catch (error) {
      if (signal.aborted) return;
      this.#failed(error, this.words.camera);
    }
  }

  /** Say how to hold the face as long as nothing else goes on; the graphs come meanwhile. */
  async #guide(camera: MediaStream, signal: AbortSignal): Promise<void> {
    try {
      // What fails here the attempt asks for again, and tells.
      await this.#prepared(signal).catch(() => undefined);
      while (!signal.aborted && this.#camera === camera) {
        const client = await this.#client?.catch(() => undefined);
        if (client && this.#isIdle && !document.hidden) {
          const fault = await client.check(this.#photo(signal), { face: this.#face });
          if (this.#isIdle && this.#camera === camera) {
            if (fault === undefined) this.#enter("ready", this.words.ready);
            else this.#enter("searching", this.#wordsOf(fault));
          }
        }
        await after(BETWEEN_LOOKS);
      }
    } catch {
      // The attempt waits for the same, and tells what went wrong.
    }
  }

  get #isIdle(): boolean {
    return ["searching", "ready", "failed"].includes(this.#state) && Date.now() >= this.#quietUntil;
  }

  async #try(): Promise<void> {
    const { signal } = this.#stay;
    try {
      const result = await this.attempt();
      if (signal.aborted) return;
      this.#stop();
      const { accept, reject, enrolled } = this.words;
      const isRejected = "accepted" in result && !result.accepted;
      const welcome = "accepted" in result ? accept : enrolled;
      // A page that says nothing itself waits for what its own server says.
      if (!isRejected) this.#enter(welcome === "" ? "off" : "accepted", welcome);
      else this.#enter("rejected", reject);
      this.#tell("veilface-result", result);
    } catch (error) {
      if (signal.aborted) return;
      this.#failed(error, this.#wordsOf(error));
    }
  }

  /** Say and tell what went wrong; the camera stays on only where another photo may help. */
  #failed(error: unknown, text: string): void {
    if (!isMendable(error)) this.#stop();
    this.#quietUntil = Date.now() + READING;
    this.#enter("failed", text);
    this.#tell("veilface-error", error);
  }

  /** The frames of a moment, as the camera gives them, not mirrored. */
  async #burst(signal: AbortSignal): Promise<RgbImage[]> {
    const photos: RgbImage[] = [];
    for (let frame = 0; frame < BURST; frame++) {
      if (frame > 0) await after(BETWEEN_FRAMES);
      photos.push(this.#photo(signal));
    }
    return photos;
  }

  /** What the camera shows now. */
  #photo(signal: AbortSignal): RgbImage {
    signal.throwIfAborted();
    return drawn(this.#video, this.#video.videoWidth, this.#video.videoHeight);
  }

  /** It was unplugged, forbidden, or taken by another program. */
  #ended(camera: MediaStream): void {
    if (this.#camera !== camera) return;
    this.reset();
    const error = new DOMException("the camera has stopped", "NotReadableError");
    this.#failed(error, this.words.camera);
  }

  #stop(): void {
    this.#camera?.getTracks().forEach((track) => track.stop());
    this.#camera = undefined;
    this.#video.srcObject = null;
  }

  /** What is on the page whatever the person does: the button, and the video's name. */
  #show(): void {
    const { start, take, enroll, again, video } = this.words;
    const isOn = this.#camera !== undefined;
    const first = this.#state === "rejected" || this.#state === "failed" ? again : start;
    this.#button.textContent = !isOn ? first : this.#enrolls ? enroll : take;
    this.#button.hidden = this.#state === "accepted";
    this.#video.setAttribute("aria-label", video);
    this.#video.hidden = !isOn;
    this.#card.className = `card ${this.#state}${isOn ? " on" : ""}`;
  }

  /** Show a state, and say this; what is said already is not said again. */
  #enter(state: State, text: string): void {
    this.#state = state;
    if (this.#status.value !== text) this.#status.value = text;
    this.#show();
  }

  #wordsOf(error: unknown): string {
    if (!(error instanceof VeilfaceError)) return error instanceof Error ? error.message : String(error);
    const { code, details, message } = error;
    const { errors, hints, liveness, locked } = this.words;
    if (details.liveness !== undefined) return liveness;
    if (Object.hasOwn(errors, code)) return errors[code];
    const hint = [code, ...Object.keys(details)].find((name) => Object.hasOwn(hints, name));
    if (hint !== undefined) return hints[hint];
    return code === "locked_out" ? `${message}. ${locked}` : message;
  }

  #tell(event: string, detail: unknown): void {
    this.dispatchEvent(new CustomEvent(event, { detail, bubbles: true, composed: true }));
  }
}

/** An element of the card, by whose name a page may style it. */
function part<K extends keyof HTMLElementTagNameMap>(tag: K, name: string): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  element.className = name;
  element.part.add(name);
  return element;
}

/** Make the element known to the page. */
export function defineLogin(name = "veilface-login"): void {
  if (customElements.get(name) === undefined) customElements.define(name, VeilfaceLogin);
}
