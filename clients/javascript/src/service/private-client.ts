/** The client that never sends a face: it embeds and lifts here, and sends private templates. */

import { VeilfaceError } from "../errors.js";
import { ModelError } from "../models/errors.js";
import { decodeImage, type RgbImage } from "../models/image.js";
import { ModelPack, type PackGraphs, type PhotoCheck } from "../models/pack.js";
import type { FacePolicy } from "../models/selection.js";
import type { Runtime } from "../models/runtime.js";
import { liftTemplate, requireContract, type PublicContract } from "../templates/contract.js";
import { DecoyGenerator } from "../templates/generator.js";
import type { Decision, Enrollment } from "./answers.js";
import { base64 } from "./base64.js";
import {
  ENROLL_PHOTOS,
  fields,
  precondition,
  PROBE_PHOTOS,
  readDecision,
  readEnrollment,
  requirePhotos,
  Session,
  subjectPath,
  type ClientOptions,
  type EnrollOptions,
  type VerifyOptions,
} from "./client.js";
import { ContractMismatch, UnexpectedAnswer } from "./errors.js";
import { holderKeyField } from "./holder-keys.js";
import { Enrollable, Probe } from "./lifts.js";
import { LiftInputs, SharedInputs } from "./lift-inputs.js";

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

/** Embeds and lifts here, and sends private templates only. Rights: `embeddings` beside the call's. */
export class PrivateClient extends Session {
  readonly #options: PrivateOptions;
  #shared: SharedInputs;
  #closed = false;

  constructor(url: string, bearer: string, options: PrivateOptions) {
    super(url, bearer, options);
    this.#options = options;
    this.#shared = new SharedInputs();
  }

  /**
   * A client under another bearer, such as the next token, with what this one has fetched or will.
   *
   * Close both: what ONNX Runtime holds is freed with the last of them.
   */
  as(bearer: string): PrivateClient {
    this.#requireOpen();
    const other = new PrivateClient(this.url, bearer, this.#options);
    other.#shared = this.#shared.join();
    return other;
  }

  /** Fetch contract, generator and graphs now, so that the first lift need not wait for them. */
  async prepare(): Promise<void> {
    await this.#with(async () => undefined);
  }

  /** Whether a photo would do, for guidance before a camera; nothing is embedded or sent of it. */
  async check(photo: Photo, { face }: { face?: FacePolicy } = {}): Promise<PhotoCheck> {
    return this.#with(async ({ pack }) => pack.checkPhoto(await imageOf(photo), { policy: face }));
  }

  /** Lift a probe; nothing is sent of it. */
  async lift(photos: readonly Photo[], { face }: { face?: FacePolicy } = {}): Promise<Probe> {
    requirePhotos(photos, PROBE_PHOTOS);
    return this.#with(
      async (inputs) =>
        new Probe(await this.#lifted(inputs, photos, face, true), inputs.contract.contract_id),
    );
  }

  /**
   * Lift a template that enrolls; nothing is sent of it.
   *
   * Never enroll the same photos twice: two lifts of them give the embedding away.
   */
  async liftEnrollment(
    photos: readonly Photo[],
    { face }: { face?: FacePolicy } = {},
  ): Promise<Enrollable> {
    requirePhotos(photos, ENROLL_PHOTOS);
    return this.#with(
      async (inputs) =>
        new Enrollable(await this.#lifted(inputs, photos, face, false), inputs.contract.contract_id),
    );
  }

  /**
   * Lift photos here (or take a lift of {@link liftEnrollment}), and enroll by it alone.
   *
   * After an error repeat with its `lift`, never with the photos.
   */
  async enroll(
    subject: string,
    photos: readonly Photo[] | Enrollable,
    options: EnrollOptions = {},
  ): Promise<Enrollment> {
    subjectPath(subject);
    if (photos instanceof Enrollable) return this.#enroll(subject, photos, options);
    return this.#withFreshContract(
      () => this.liftEnrollment(photos, options),
      (lift) => this.#enroll(subject, lift, options),
    );
  }

  /** Lift photos here (or take a probe of {@link lift}), and verify by it alone. */
  async verify(
    subject: string,
    photos: readonly Photo[] | Probe,
    options: VerifyOptions = {},
  ): Promise<Decision> {
    subjectPath(subject);
    if (photos instanceof Probe) return this.#verify(subject, photos, options);
    return this.#withFreshContract(
      () => this.lift(photos, options),
      (lift) => this.#verify(subject, lift, options),
    );
  }

  /** Free what ONNX Runtime holds, where no other client and no lift needs it. */
  async close(): Promise<void> {
    if (this.#closed) return;
    this.#closed = true;
    await this.#shared.leave();
  }

  #requireOpen(): void {
    if (this.#closed) throw new Error("this client was closed: make another one");
  }

  async #with<T>(use: (inputs: LiftInputs) => Promise<T>): Promise<T> {
    this.#requireOpen();
    const inputs = await this.#shared.taken(() => this.#fetched());
    try {
      return await use(inputs);
    } finally {
      await inputs.leave();
    }
  }

  async #fetched(): Promise<LiftInputs> {
    for (let look = 0; look < LOOKS; look++) {
      const contract = await this.contract();
      const generator = await DecoyGenerator.fromBytes(await this.generator());
      // The contract may have changed between the two answers, or between two workers.
      if (generator.sourceId !== contract.binding.decoy_source_id) continue;
      await requireContract(contract, generator);
      const graphs = await (this.#options.graphs?.(contract) ?? this.pack());
      const { runtime, sessionOptions } = this.#options;
      const pack = await ModelPack.load(runtime, contract, graphs, sessionOptions);
      return new LiftInputs(contract, generator, pack);
    }
    throw new UnexpectedAnswer("the generator of the service is not that of its contract");
  }

  async #lifted(
    { contract, generator, pack }: LiftInputs,
    photos: readonly Photo[],
    face: FacePolicy | undefined,
    probe: boolean,
  ): Promise<Uint8Array> {
    const embeddings: Float32Array[] = [];
    for (const [index, photo] of photos.entries()) {
      this.#options.signal?.throwIfAborted();
      try {
        const image = await imageOf(photo);
        embeddings.push((await pack.embedPhoto(image, { policy: face })).embedding);
      } catch (error) {
        if (error instanceof ModelError) error.image = index;
        throw error;
      }
    }
    return liftTemplate(contract, generator, embeddings, { probe, dim: this.#options.dim });
  }

  /** Lift and send; once more under the contract in force where it is another one by now. */
  async #withFreshContract<L extends Enrollable | Probe, T>(
    lift: () => Promise<L>,
    send: (lift: L) => Promise<T>,
  ): Promise<T> {
    const first = await lift();
    try {
      return await send(first);
    } catch (error) {
      if (!(error instanceof ContractMismatch)) throw error;
      await this.#shared.forget(first.contractId);
      const inForce = await this.#with(async ({ contract }) => contract.contract_id);
      // Else it is the subject's stored template that is of another contract.
      if (inForce === first.contractId) throw error;
    }
    return send(await lift());
  }

  async #enroll(subject: string, lift: Enrollable, options: EnrollOptions): Promise<Enrollment> {
    const { holderKey, replace } = options;
    const headers = precondition(replace);
    const template = base64(lift.template);
    const body = fields({ template, ...holderKeyField(holderKey) });
    const path = subjectPath(subject, "/enrollment");
    return this.#naming(lift, () =>
      this.send({
        method: "PUT",
        path,
        headers,
        body: () => body,
        read: readEnrollment,
        resend: this.resendOf(replace),
      }),
    );
  }

  async #verify(subject: string, lift: Probe, options: VerifyOptions): Promise<Decision> {
    const { level, holderKey } = options;
    const template = base64(lift.template);
    const body = fields({ template, level, ...holderKeyField(holderKey) });
    return this.#naming(lift, () =>
      this.send({
        method: "POST",
        path: subjectPath(subject, "/verify"),
        body: () => body,
        read: readDecision,
        resend: "when-not-done",
      }),
    );
  }

  /** The error that ends a lift's sending has it, so that callers can repeat it. */
  async #naming<T>(lift: Enrollable | Probe, send: () => Promise<T>): Promise<T> {
    try {
      return await send();
    } catch (error) {
      if (error instanceof VeilfaceError && !(error instanceof ContractMismatch)) error.lift = lift;
      throw error;
    }
  }
}

const imageOf = async (photo: Photo): Promise<RgbImage> =>
  photo instanceof Blob ? decodeImage(photo) : photo;
