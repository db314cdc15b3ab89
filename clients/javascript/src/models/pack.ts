/** The graphs of a contract, which together turn a photo into an embedding. */

import { align, TEMPLATE_NAME } from "./alignment.js";
import { centreRank, type Box, type Face } from "./boxes.js";
import { DEFAULT_SIZE, findFaces, type Detector, type Size } from "./detection.js";
import { Embedder, PREPROCESSING_VERSION, type Preprocessing } from "./embedding.js";
import { FaceError, ModelError, PackError } from "./errors.js";
import { resizeArea, resizeLinear, type RgbImage } from "./image.js";
import { requireUpright } from "./orientation.js";
import {
  check,
  DEFAULT_QUALITY,
  measure,
  type Quality,
  type QualityLimits,
} from "./quality.js";
import { Graph, type Runtime } from "./runtime.js";
import { Scrfd } from "./scrfd.js";
import { selectFace, type FacePolicy } from "./selection.js";
import { YuNet, YUNET_OUTPUTS } from "./yunet.js";

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

/** Whether a photo would do: what `POST /v1/photos/check` answers of one. */
export interface PhotoCheck {
  readonly usable: boolean;
  /** Why not, as in the REST contract; null if it is usable. */
  readonly code: FaceError["code"] | null;
  readonly message: string;
  readonly details: Readonly<Record<string, unknown>>;
  /** Of the face, in pixels of the upright photo; null if it is not usable, or came aligned. */
  readonly box: Box | null;
  /** What was measured; null if it is not usable. */
  readonly quality: Quality | null;
}

/** One face of a photo, before it is embedded. Printing it shows no pixel. */
export class FaceCrop {
  readonly #crop: RgbImage;

  constructor(
    crop: RgbImage,
    readonly quality: Quality,
    /** As it was detected; undefined for crops that came aligned. */
    readonly face: Face | undefined,
  ) {
    this.#crop = crop;
  }

  /** Aligned on the template. */
  get crop(): RgbImage {
    return this.#crop;
  }
}

/** One face of a photo, embedded. Printing it shows no number of the embedding. */
export class FaceSample extends FaceCrop {
  readonly #embedding: Float32Array;

  constructor(taken: FaceCrop, embedding: Float32Array) {
    super(taken.crop, taken.quality, taken.face);
    this.#embedding = embedding;
  }

  /** n values of unit norm. */
  get embedding(): Float32Array {
    return this.#embedding;
  }
}

/** An embedder with its preprocessing and, usually, a detector. Make one with `load`. */
export class ModelPack {
  private constructor(
    readonly n: number,
    private readonly embedder: Embedder,
    private readonly detector: Detector | undefined,
  ) {}

  /**
   * Load the graphs of a contract, each after its SHA-256 was compared with the contract's.
   *
   * @param runtime the module `onnxruntime-web` or `onnxruntime-node`.
   * @param options of ONNX Runtime's session, such as `{ executionProviders: ["webgpu", "wasm"] }`.
   * @throws PackError if a graph is not that of the contract, or cannot be used.
   */
  static async load(
    runtime: Runtime,
    contract: PackContract,
    graphs: PackGraphs,
    options?: object,
  ): Promise<ModelPack> {
    const { binding, recorded } = contract;
    const { preprocessing, n } = binding;
    if (
      preprocessing.alignment !== TEMPLATE_NAME ||
      preprocessing.version !== PREPROCESSING_VERSION
    ) {
      throw new PackError(
        "the contract prepares photos in another way than this version of veilface-client",
      );
    }
    if ((recorded.detector_sha256 === undefined) !== (graphs.detector === undefined)) {
      throw new PackError("the pack has a detector and the contract none, or the other way round");
    }
    await requireSha256("embedder", graphs.embedder, binding.embedder_sha256);
    const embedder = new Embedder(
      await Graph.load(runtime, graphs.embedder, options),
      preprocessing,
    );
    if (graphs.detector === undefined) return new ModelPack(n, embedder, undefined);
    try {
      await requireSha256("detector", graphs.detector, recorded.detector_sha256);
      const size = recorded.detector_input_size?.[0] ?? DEFAULT_SIZE;
      const detector = await loadDetector(runtime, graphs.detector, size, options);
      return new ModelPack(n, embedder, detector);
    } catch (error) {
      await embedder.release();
      throw error;
    }
  }

  /** Faces of a picture, the one most likely meant first. */
  async detect(image: RgbImage): Promise<Face[]> {
    if (this.detector === undefined) throw new PackError("the pack has no detector");
    const rank = (face: Face): number => centreRank(face, image.width, image.height);
    return (await findFaces(this.detector, image)).sort((a, b) => rank(b) - rank(a));
  }

  /** Find the face, align and check it: {@link embedPhoto} without the embedding. */
  async cropPhoto(
    image: RgbImage,
    { policy = "dominant", limits = DEFAULT_QUALITY }: CropOptions = {},
  ): Promise<FaceCrop> {
    const { size } = this.embedder.preprocessing;
    let face: Face | undefined;
    let crop: RgbImage;
    if (this.detector === undefined) {
      crop = asAligned(image, size);
    } else {
      face = selectFace(await this.detect(image), policy, image, limits.min_face_size);
      crop = align(image, face.keypoints, size);
      await requireUpright(this.detector, face, crop);
    }
    const quality = measure(crop, face, image);
    check(quality, limits, this.detector?.recommendedScore ?? 0);
    return new FaceCrop(crop, quality, face);
  }

  /** Whether a photo would do, and where its face is: {@link cropPhoto} without its refusals. */
  async checkPhoto(image: RgbImage, options: CropOptions = {}): Promise<PhotoCheck> {
    try {
      const { face, quality } = await this.cropPhoto(image, options);
      const message =
        face === undefined
          ? "an aligned crop of a face, clear enough"
          : "one face, large and clear enough";
      return { usable: true, code: null, message, details: {}, box: face?.box ?? null, quality };
    } catch (error) {
      if (!(error instanceof FaceError)) throw error;
      const { code, message, details } = error;
      return { usable: false, code, message, details, box: null, quality: null };
    }
  }

  /**
   * From a photo to the embedding of its face.
   *
   * @throws FaceError `NoFace`, `MultipleFaces`, `FaceTooSmall` or `LowQuality`.
   */
  async embedPhoto(image: RgbImage, options: CropOptions = {}): Promise<FaceSample> {
    const taken = await this.cropPhoto(image, options);
    const embedding = await this.embedder.embed(taken.crop);
    if (embedding.length !== this.n) {
      throw new ModelError(`the embedder gives ${embedding.length} numbers, not ${this.n}`);
    }
    return new FaceSample(taken, embedding);
  }

  /** Free what ONNX Runtime holds. */
  async release(): Promise<void> {
    await this.embedder.release();
    await this.detector?.release();
  }
}

/** How a photo is taken. */
export interface CropOptions {
  readonly policy?: FacePolicy | undefined;
  readonly limits?: QualityLimits;
}

/** SHA-256 in lower-case hexadecimal digits. */
export async function sha256(bytes: Uint8Array): Promise<string> {
  return hex(new Uint8Array(await crypto.subtle.digest("SHA-256", bytes as BufferSource)));
}

/** Lower-case hexadecimal digits. */
export function hex(bytes: Uint8Array): string {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

async function requireSha256(
  what: string,
  bytes: Uint8Array,
  expected: string | undefined,
): Promise<void> {
  const seen = await sha256(bytes);
  if (seen !== expected) {
    throw new PackError(
      `the ${what} has the SHA-256 ${seen.slice(0, 16)}…, the contract names ` +
        `${String(expected).slice(0, 16)}…: use the pack that the contract was calibrated with`,
    );
  }
}

async function loadDetector(
  runtime: Runtime,
  bytes: Uint8Array,
  size: number,
  options: object | undefined,
): Promise<Detector> {
  const graph = await Graph.load(runtime, bytes, options);
  const [, , height, width] = graph.inputShape;
  const fixed: Size | undefined =
    height !== undefined && width !== undefined ? [height, width] : undefined;
  const isYuNet = YUNET_OUTPUTS.every((name) => graph.outputNames.includes(name));
  if (!isYuNet && graph.outputNames.length !== 9) {
    await graph.release();
    throw new PackError("the detector is neither SCRFD with five points nor YuNet");
  }
  return isYuNet ? new YuNet(graph, size, fixed) : new Scrfd(graph, size, fixed);
}

/** Take a square picture as an aligned crop, resized to the embedder's size. */
function asAligned(image: RgbImage, size: number): RgbImage {
  if (image.width !== image.height) {
    throw new ModelError("an aligned crop must be square; for other photos use a detector");
  }
  const resize = image.height > size ? resizeArea : resizeLinear;
  return resize(image, size, size);
}
