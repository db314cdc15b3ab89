/** What is used of ONNX Runtime: the caller gives its module, so that this package bundles none. */

import { unusable } from "../errors.js";

/** The module `onnxruntime-web` or `onnxruntime-node`. */
export interface Runtime {
  readonly InferenceSession: {
    create(graph: Uint8Array, options?: object): Promise<RuntimeSession>;
  };
  readonly Tensor: new (type: "float32", data: Float32Array, dims: readonly number[]) => unknown;
}

/** A graph that ONNX Runtime has loaded. */
export interface RuntimeSession {
  readonly inputNames: readonly string[];
  readonly outputNames: readonly string[];
  /** Shape of each input, a text for a size that is open; ONNX Runtime 1.22 and later. */
  readonly inputMetadata: readonly unknown[];
  run(feeds: object, options?: object): Promise<Readonly<Record<string, unknown>>>;
  release(): Promise<void>;
}

/** A tensor of float32. */
export interface Tensor {
  readonly dims: readonly number[];
  readonly data: Float32Array;
}

// Detectors state other output shapes than they give: a warning for each, with every photo.
const ERRORS_ONLY = { logSeverityLevel: 3 };

/** A graph with one image input, (batch, 3, height, width). */
export class Graph {
  private constructor(
    private readonly runtime: Runtime,
    private readonly session: RuntimeSession,
    /** Sizes of the input, undefined where any will do. */
    readonly inputShape: readonly (number | undefined)[],
  ) {}

  /** Load a graph; throws `unusable_contract` where it is none, or has another input than one image. */
  static async load(runtime: Runtime, bytes: Uint8Array, options?: object): Promise<Graph> {
    let session: RuntimeSession;
    try {
      session = await runtime.InferenceSession.create(bytes, { ...ERRORS_ONLY, ...options });
    } catch (error) {
      throw unusable(`ONNX Runtime does not load a graph of the pack: ${String(error)}`);
    }
    const input = session.inputMetadata?.[0] as { shape?: readonly unknown[] } | undefined;
    if (session.inputNames.length !== 1 || input?.shape?.length !== 4) {
      await session.release();
      throw unusable("a graph of the pack has not one image input, or ONNX Runtime is too old");
    }
    const shape = input.shape.map((size) => (typeof size === "number" && size > 0 ? size : undefined));
    return new Graph(runtime, session, shape);
  }

  get outputNames(): readonly string[] {
    return this.session.outputNames;
  }

  /** Run on a batch of images; the outputs by their names. */
  async run(data: Float32Array, dims: readonly number[]): Promise<Map<string, Tensor>> {
    const input = new this.runtime.Tensor("float32", data, dims);
    try {
      const outputs = await this.session.run({ [this.session.inputNames[0]]: input }, ERRORS_ONLY);
      return new Map(this.outputNames.map((name) => [name, outputs[name] as Tensor]));
    } catch (error) {
      throw unusable(`ONNX Runtime does not run a graph of the pack: ${String(error)}`);
    }
  }

  /** Free what ONNX Runtime holds. */
  release(): Promise<void> {
    return this.session.release();
  }
}

/** Values of a picture as (1, 3, height, width): `(x - mean) * factor` of each channel. */
export function planes(
  image: { readonly data: Uint8Array },
  order: "rgb" | "bgr",
  mean: readonly number[],
  factor: readonly number[],
): Float32Array {
  const count = image.data.length / 3;
  const out = new Float32Array(3 * count);
  for (let channel = 0; channel < 3; channel++) {
    const from = order === "rgb" ? channel : 2 - channel;
    const [less, times] = [Math.fround(mean[channel]), Math.fround(factor[channel])];
    for (let i = 0; i < count; i++) {
      out[channel * count + i] = Math.fround(image.data[3 * i + from] - less) * times;
    }
  }
  return out;
}
