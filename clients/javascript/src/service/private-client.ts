/** The client that never sends a face: it embeds and lifts here, and sends private templates. */

import type { Decision, Enrollment } from "../answers.js";
import { base64, concealed } from "../bytes.js";
import { isPhotoRefused, VeilfaceError } from "../errors.js";
import type { FacePolicy } from "../models/faces.js";
import { decodeImage, type RgbImage } from "../models/image.js";
import { ModelPack, type PackGraphs } from "../models/pack.js";
import type { Runtime } from "../models/runtime.js";
import { liftTemplate, requireContract, type PublicContract } from "../templates/contract.js";
import { DecoyGenerator } from "../templates/generator.js";
import { given, keyField, Session, subjectPath, type EnrollOptions, type VerifyOptions } from "./client.js";
import type { ClientOptions } from "./sending.js";

const LOOKS = 3;
const MOST_PHOTOS = { enrollment: 10, probe: 5 };

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

/** What one contract lifts with. */
interface Lifter {
  readonly contract: PublicContract;
  readonly generator: DecoyGenerator;
  readonly pack: ModelPack;
}

/** Embeds and lifts here, and sends private templates only. Rights: `embeddings` beside the call's. */
export class PrivateClient extends Session {
  readonly #options: PrivateOptions;
  #lifter: Lifter | undefined;
  // ONNX Runtime does one thing at a time: what is asked for waits for what was asked for before.
  #last: Promise<unknown> = Promise.resolve();
  #isClosed = false;

  constructor(url: string, bearer: string, options: PrivateOptions) {
    super(url, bearer, options);
    this.#options = options;
  }

  /** Fetch contract, generator and graphs now, so that the first lift need not wait for them. */
  async prepare(): Promise<void> {
    await this.#with(async () => undefined);
  }

  /** Say why a photo will not do, or undefined: guidance before a camera, of which nothing is embedded or sent. */
  async check(photo: Photo, { face }: { face?: FacePolicy } = {}): Promise<VeilfaceError | undefined> {
    return this.#with(async ({ pack }) => pack.checkPhoto(await imageOf(photo), face));
  }

  /** Lift a probe; nothing is sent of it. */
  async lift(photos: readonly Photo[], { face }: { face?: FacePolicy } = {}): Promise<Lift> {
    return this.#lifted("probe", photos, face);
  }

  /**
   * Lift a template that enrolls; nothing is sent of it.
   *
   * Never enroll the same photos twice: two lifts of them give the embedding away.
   */
  async liftEnrollment(photos: readonly Photo[], { face }: { face?: FacePolicy } = {}): Promise<Lift> {
    return this.#lifted("enrollment", photos, face);
  }

  /**
   * Lift photos here (or take a lift of {@link liftEnrollment}), and enroll by it alone.
   *
   * After an error repeat with its `lift`, never with the photos.
   *
   * @param options.token for this call, in the place of the client's bearer.
   */
  async enroll(
    subject: string,
    photos: readonly Photo[] | Lift,
    options: EnrollOptions & { readonly token?: string } = {},
  ): Promise<Enrollment> {
    subjectPath(subject);
    const { holderKey, replace, token } = options;
    const lift = photos instanceof Lift ? photos : await this.liftEnrollment(photos, options);
    return this.#sending(lift, (template) =>
      this.putEnrollment(subject, replace, given({ template, ...keyField(holderKey) }), token),
    );
  }

  /** Lift photos here (or take a probe of {@link lift}), and verify by it alone; `token` as for {@link enroll}. */
  async verify(
    subject: string,
    photos: readonly Photo[] | Lift,
    options: VerifyOptions & { readonly token?: string } = {},
  ): Promise<Decision> {
    subjectPath(subject);
    const { level, holderKey, token } = options;
    const lift = photos instanceof Lift ? photos : await this.lift(photos, options);
    return this.#sending(lift, (template) =>
      this.postProbe(subject, given({ template, level, ...keyField(holderKey) }), token),
    );
  }

  /** Free what ONNX Runtime holds, after what goes on. */
  async close(): Promise<void> {
    this.#isClosed = true;
    await this.#forget();
  }

  /** Send a lift; an error has it, to repeat the call with. */
  async #sending<T>(lift: Lift, send: (template: string) => Promise<T>): Promise<T> {
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

  #inTurn<T>(work: () => Promise<T>): Promise<T> {
    const result = this.#last.then(work);
    this.#last = result.catch(() => undefined);
    return result;
  }

  #with<T>(work: (lifter: Lifter) => Promise<T>): Promise<T> {
    return this.#inTurn(async () => {
      if (this.#isClosed) throw new Error("this client was closed: make another one");
      this.#lifter ??= await this.#fetched();
      return work(this.#lifter);
    });
  }

  /** Have the next lift fetch the contract in force. */
  #forget(): Promise<void> {
    return this.#inTurn(async () => {
      const lifter = this.#lifter;
      this.#lifter = undefined;
      await lifter?.pack.release();
    });
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
      return { contract, generator, pack };
    }
    throw new VeilfaceError("unexpected_answer", "the generator of the service is not that of its contract");
  }

  #lifted(kind: Lift["kind"], photos: readonly Photo[], face: FacePolicy | undefined): Promise<Lift> {
    const most = MOST_PHOTOS[kind];
    if (photos.length < 1 || photos.length > most) {
      throw new RangeError(`1 to ${most} photos are taken, not ${photos.length}`);
    }
    return this.#with(async ({ contract, generator, pack }) => {
      const embeddings: Float32Array[] = [];
      for (const [index, photo] of photos.entries()) {
        this.signal?.throwIfAborted();
        try {
          embeddings.push((await pack.embedPhoto(await imageOf(photo), face)).embedding);
        } catch (error) {
          if (isPhotoRefused(error)) error.image = index;
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
