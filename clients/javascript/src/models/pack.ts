/** The graphs of a contract, which together turn a photo into an embedding. */

import { concealed, sha256 } from "../bytes.js";
import { isPhotoRefused, unusable, type VeilfaceError } from "../errors.js";
import { align, TEMPLATE_NAME } from "./alignment.js";
import { DEFAULT_SIZE, Detector, findFaces, type Size } from "./detection.js";
import { embed, PREPROCESSING_VERSION, type Preprocessing } from "./embedding.js";
import { selectFace, type Face, type FacePolicy } from "./faces.js";
import { resizeArea, resizeLinear, type RgbImage } from "./image.js";
import { requireUpright } from "./orientation.js";
import { measure, QUALITY_LIMITS, requireQuality, type Quality } from "./quality.js";
import { Graph, type Runtime } from "./runtime.js";

/** What a contract says of the pack: `binding` and `recorded` of `GET /v1/contract`. */
export interface PackContract {
  readonly binding: {
    readonly embedder_sha256: string;
    readonly preprocessing: Preprocessing;
    readonly n: number;
  };
  readonly recorded: {
    readonly detector_sha256?: string;
    readonly detector_input_size?: Size;
  };
}

/** The bytes of the pack's graphs. */
export interface PackGraphs {
  readonly embedder: Uint8Array;
  /** Absent where the contract names none: photos are then aligned crops. */
  readonly detector?: Uint8Array;
}

/** One face of a photo. Printing it shows no pixel, and no number of the embedding. */
export interface FaceSample {
  /** Aligned on the template. */
  readonly crop: RgbImage;
  readonly quality: Quality;
  /** As it was detected; undefined for crops that came aligned. */
  readonly face: Face | undefined;
  /** n values of unit norm. */
  readonly embedding: Float32Array;
}

/** An embedder with its preprocessing and, usually, a detector. Make one with `load`. */
export class ModelPack {
  private constructor(
    private readonly binding: PackContract["binding"],
    private readonly embedder: Graph,
    private readonly detector: Detector | undefined,
  ) {}

  /**
   * Load the graphs of a contract, each after its SHA-256 was compared with the contract's.
   *
   * @param runtime the module `onnxruntime-web` or `onnxruntime-node`.
   * @param options of ONNX Runtime's session, such as `{ executionProviders: ["webgpu", "wasm"] }`.
   * @throws `unusable_contract` if a graph is not that of the contract, or cannot be used.
   */
  static async load(
    runtime: Runtime,
    contract: PackContract,
    graphs: PackGraphs,
    options?: object,
  ): Promise<ModelPack> {
    const { binding, recorded } = contract;
    const { alignment, version } = binding.preprocessing;
    if (alignment !== TEMPLATE_NAME || version !== PREPROCESSING_VERSION) {
      throw unusable("this client does not go the contract's way from a photo to its crop");
    }
    if ((recorded.detector_sha256 === undefined) !== (graphs.detector === undefined)) {
      throw unusable("the pack has a detector and the contract none, or the other way round");
    }
    await requireSha256("embedder", graphs.embedder, binding.embedder_sha256);
    if (graphs.detector) await requireSha256("detector", graphs.detector, recorded.detector_sha256);
    const loaded: Graph[] = [];
    try {
      loaded.push(await Graph.load(runtime, graphs.embedder, options));
      if (graphs.detector) loaded.push(await Graph.load(runtime, graphs.detector, options));
      const [embedder, detector] = loaded;
      const size = recorded.detector_input_size?.[0] ?? DEFAULT_SIZE;
      return new ModelPack(binding, embedder, detector && new Detector(detector, size));
    } catch (error) {
      for (const graph of loaded) await graph.release();
      throw error;
    }
  }

  /** Why a photo will not do, or undefined; nothing is embedded. */
  async checkPhoto(image: RgbImage, policy?: FacePolicy): Promise<VeilfaceError | undefined> {
    try {
      await this.#crop(image, policy);
      return undefined;
    } catch (error) {
      if (isPhotoRefused(error)) return error;
      throw error;
    }
  }

  /**
   * From a photo to the embedding of its face.
   *
   * @throws `no_face`, `multiple_faces`, `face_too_small` or `low_quality`.
   */
  async embedPhoto(image: RgbImage, policy?: FacePolicy): Promise<FaceSample> {
    const taken = await this.#crop(image, policy);
    const embedding = await embed(this.embedder, taken.crop, this.binding.preprocessing);
    if (embedding.length !== this.binding.n) {
      throw unusable(`the embedder gives ${embedding.length} numbers, not ${this.binding.n}`);
    }
    return concealed({ ...taken, embedding }, "crop", "embedding");
  }

  /** Free what ONNX Runtime holds. */
  async release(): Promise<void> {
    await this.embedder.release();
    await this.detector?.release();
  }

  /** Find the face that is meant, align it, and check its quality. */
  async #crop(image: RgbImage, policy: FacePolicy = "dominant"): Promise<Omit<FaceSample, "embedding">> {
    const { size } = this.binding.preprocessing;
    const { detector } = this;
    let face: Face | undefined;
    let crop: RgbImage;
    if (detector === undefined) {
      crop = asAligned(image, size);
    } else {
      face = selectFace(await findFaces(detector, image), policy, image, QUALITY_LIMITS.face_size);
      crop = align(image, face.keypoints, size);
      await requireUpright(detector, face, crop);
    }
    const quality = measure(crop, face, image);
    requireQuality(quality, detector?.family.recommendedScore ?? 0);
    return { crop, quality, face };
  }
}

async function requireSha256(what: string, bytes: Uint8Array, expected = "none"): Promise<void> {
  const seen = await sha256(bytes);
  if (seen === expected) return;
  throw unusable(
    `the ${what} has the SHA-256 ${seen.slice(0, 16)}…, the contract names ${expected.slice(0, 16)}…: ` +
      "use the pack that the contract was calibrated with",
  );
}

/** Take a square picture as an aligned crop, resized to the embedder's size. */
function asAligned(image: RgbImage, size: number): RgbImage {
  if (image.width !== image.height) {
    throw new RangeError("an aligned crop must be square; for other photos use a detector");
  }
  const resize = image.height > size ? resizeArea : resizeLinear;
  return resize(image, size, size);
}
