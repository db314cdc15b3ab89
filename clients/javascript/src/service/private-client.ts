/** The client that never sends a face: it embeds and lifts here, and sends private templates. */

import type { Decision, Enrollment } from "../answers.js";
import { base64, concealed } from "../bytes.js";
import { PhotoError, UnexpectedAnswer, VeilfaceError } from "../errors.js";
import type { FacePolicy } from "../models/faces.js";
import { decodeImage, type RgbImage } from "../models/image.js";
import { ModelPack, type PackGraphs, type PhotoCheck } from "../models/pack.js";
import type { Runtime } from "../models/runtime.js";
import { liftTemplate, requireContract, type PublicContract } from "../templates/contract.js";
import { DecoyGenerator } from "../templates/generator.js";
import {
  ENROLL_PHOTOS,
  given,
  keyField,
  PROBE_PHOTOS,
  requirePhotos,
  Session,
  subjectPath,
  type EnrollOptions,
  type VerifyOptions,
} from "./client.js";
import type { ClientOptions } from "./sending.js";

const LOOKS = 3;

/** A picture; in a browser also a file of one. */
export type Photo = RgbImage | Blob;

/** How a private client embeds. */
export interface PrivateOptions extends ClientOptions {
  /** The module `onnxruntime-web` or `onnxruntime-node`. */
  readonly runtime: Runtime;
  /** Where the graphs of a contract are; by default the service gives them, to a token. */
  readonly graphs?: (contract: PublicContract) => Promise<PackGraphs>;
  /** Of ONNX Runtime, such as `{ executionProviders: ["webgpu", "wasm"] }`. */
  readonly sessionOptions?: object;
  /** Dimension of probes; by default the largest that the contract takes. */
  readonly dim?: number;
}

/** What a client has lifted: a template that enrolls, or a probe; no photo, and no embedding. */
export class Lift {
  constructor(
    /** A probe is sent once for each attempt that it is meant for. */
    readonly kind: "enrollment" | "probe",
    readonly contractId: string,
    /** The wire bytes. Printing the lift does not show them. */
    readonly template: Uint8Array,
  ) {
    concealed(this, "template");
  }
}

/** What one contract lifts with. Its lifts run one after the other, and it is freed after the last. */
class Lifter {
  #last: Promise<unknown> = Promise.resolve();

  constructor(
    readonly contract: PublicContract,
    readonly generator: DecoyGenerator,
    readonly pack: ModelPack,
  ) {}

  use<T>(work: (lifter: Lifter) => Promise<T>): Promise<T> {
    const result = this.#last.then(() => work(this));
    this.#last = result.catch(() => undefined);
    return result;
  }

  free(): Promise<void> {
    return this.use(({ pack }) => pack.release());
  }
}

/** Embeds and lifts here, and sends private templates only. Rights: `embeddings` beside the call's. */
export class PrivateClient extends Session {
  readonly #options: PrivateOptions;
  // One for this client and those that `as` made of it.
  #shared: { clients: number; lifter: Promise<Lifter> | undefined };
  #isClosed = false;

  constructor(url: string, bearer: string, options: PrivateOptions) {
    super(url, bearer, options);
    this.#options = options;
    this.#shared = { clients: 1, lifter: undefined };
  }

  /**
   * A client under another bearer, such as the next token, with what this one has fetched or will.
   *
   * Close both: what ONNX Runtime holds is freed with the last of them.
   */
  as(bearer: string): PrivateClient {
    this.#requireOpen();
    const other = new PrivateClient(this.url, bearer, this.#options);
    other.#shared = this.#shared;
    this.#shared.clients++;
    return other;
  }

  /** Fetch contract, generator and graphs now, so that the first lift need not wait for them. */
  async prepare(): Promise<void> {
    await this.#with(async () => undefined);
  }

  /** Whether a photo would do, for guidance before a camera; nothing is embedded or sent of it. */
  async check(photo: Photo, { face }: { face?: FacePolicy } = {}): Promise<PhotoCheck> {
    return this.#with(async ({ pack }) => pack.checkPhoto(await imageOf(photo), face));
  }

  /** Lift a probe; nothing is sent of it. */
  async lift(photos: readonly Photo[], { face }: { face?: FacePolicy } = {}): Promise<Lift> {
    requirePhotos(photos, PROBE_PHOTOS);
    return this.#lifted("probe", photos, face);
  }

  /**
   * Lift a template that enrolls; nothing is sent of it.
   *
   * Never enroll the same photos twice: two lifts of them give the embedding away.
   */
  async liftEnrollment(photos: readonly Photo[], { face }: { face?: FacePolicy } = {}): Promise<Lift> {
    requirePhotos(photos, ENROLL_PHOTOS);
    return this.#lifted("enrollment", photos, face);
  }

  /**
   * Lift photos here (or take a lift of {@link liftEnrollment}), and enroll by it alone.
   *
   * After an error repeat with its `lift`, never with the photos.
   */
  async enroll(
    subject: string,
    photos: readonly Photo[] | Lift,
    options: EnrollOptions = {},
  ): Promise<Enrollment> {
    subjectPath(subject);
    const { holderKey, replace } = options;
    return this.#send(
      photos instanceof Lift ? photos : () => this.liftEnrollment(photos, options),
      (template) => this.putEnrollment(subject, replace, { template, ...keyField(holderKey) }),
    );
  }

  /** Lift photos here (or take a probe of {@link lift}), and verify by it alone. */
  async verify(
    subject: string,
    photos: readonly Photo[] | Lift,
    options: VerifyOptions = {},
  ): Promise<Decision> {
    subjectPath(subject);
    const { level, holderKey } = options;
    return this.#send(
      photos instanceof Lift ? photos : () => this.lift(photos, options),
      (template) => this.postProbe(subject, given({ template, level, ...keyField(holderKey) })),
    );
  }

  /** Free what ONNX Runtime holds, where no other client and no lift needs it. */
  async close(): Promise<void> {
    if (this.#isClosed) return;
    this.#isClosed = true;
    if (--this.#shared.clients === 0) await this.#forget();
  }

  #requireOpen(): void {
    if (this.#isClosed) throw new Error("this client was closed: make another one");
  }

  /** Send a lift, or what is lifted now; an error has the lift, to repeat the call with. */
  async #send<T>(lifting: Lift | (() => Promise<Lift>), send: (template: string) => Promise<T>): Promise<T> {
    const lift = lifting instanceof Lift ? lifting : await lifting();
    try {
      return await send(base64(lift.template));
    } catch (error) {
      if (!(error instanceof VeilfaceError)) throw error;
      // Not lifted again here: a service that only claims to have changed would get two lifts.
      if (error.code === "contract_mismatch") await this.#forget();
      else error.lift = lift;
      throw error;
    }
  }

  /** Have the next lift fetch the contract in force. */
  async #forget(): Promise<void> {
    const { lifter } = this.#shared;
    this.#shared.lifter = undefined;
    // A preparation that failed holds nothing, and its error is that of its caller.
    await (await lifter?.catch(() => undefined))?.free();
  }

  async #with<T>(work: (lifter: Lifter) => Promise<T>): Promise<T> {
    this.#requireOpen();
    const fetching = (this.#shared.lifter ??= this.#fetched());
    let lifter: Lifter;
    try {
      lifter = await fetching;
    } catch (error) {
      // What failed to come is fetched again by the next lift.
      if (this.#shared.lifter === fetching) this.#shared.lifter = undefined;
      throw error;
    }
    this.#requireOpen();
    return lifter.use(work);
  }

  async #fetched(): Promise<Lifter> {
    for (let look = 0; look < LOOKS; look++) {
      const contract = await this.contract();
      const generator = await DecoyGenerator.fromBytes(await this.generator());
      // The contract may have changed between the two answers, or between two workers.
      if (generator.sourceId !== contract.binding.decoy_source_id) continue;
      await requireContract(contract, generator);
      const graphs = await (this.#options.graphs?.(contract) ?? this.pack());
      const { runtime, sessionOptions } = this.#options;
      const pack = await ModelPack.load(runtime, contract, graphs, sessionOptions);
      return new Lifter(contract, generator, pack);
    }
    throw new UnexpectedAnswer("the generator of the service is not that of its contract");
  }

  #lifted(kind: Lift["kind"], photos: readonly Photo[], face: FacePolicy | undefined): Promise<Lift> {
    return this.#with(async ({ contract, generator, pack }) => {
      const embeddings: Float32Array[] = [];
      for (const [index, photo] of photos.entries()) {
        this.sender.signal?.throwIfAborted();
        try {
          embeddings.push((await pack.embedPhoto(await imageOf(photo), face)).embedding);
        } catch (error) {
          if (error instanceof PhotoError) error.image = index;
          throw error;
        }
      }
      const options = { probe: kind === "probe", dim: this.#options.dim };
      const template = liftTemplate(contract, generator, embeddings, options);
      return new Lift(kind, contract.contract_id, template);
    });
  }
}

const imageOf = async (photo: Photo): Promise<RgbImage> =>
  photo instanceof Blob ? decodeImage(photo) : photo;
