/**
 * What can go wrong between a photo and its embedding.
 *
 * ```text
 * ModelError
 * ├── PackError                a pack that is not that of the contract, or does not run
 * ├── ImageError               .code: a file that is no picture that can be read
 * └── FaceError                .code, .details: a picture with no usable face in it
 *     ├── NoFace
 *     ├── MultipleFaces
 *     ├── FaceTooSmall
 *     └── LowQuality
 * ```
 *
 * Messages name the cause and the remedy. They never hold a pixel or a number of an embedding.
 */

import { VeilfaceError } from "../errors.js";

/** Base of all errors between a photo and its embedding. */
export class ModelError extends VeilfaceError {
  override name = "ModelError";

  /** Position from 0 of the photo that it is about, where several were lifted together. */
  image: number | undefined = undefined;
}

/** A pack that is not that of the contract, or does not run. */
export class PackError extends ModelError {
  override name = "PackError";
}

/** A file that is no picture that can be read. */
export class ImageError extends ModelError {
  override name = "ImageError";
  readonly code = "unsupported_image";

  constructor() {
    super("The file is not a picture that this browser reads; send a JPEG or PNG.");
  }
}

/** What was measured, and its limit. */
export interface Measured {
  readonly value: number;
  readonly limit: number;
}

/** A picture that was read, in which no usable face was found. */
export class FaceError extends ModelError {
  override name = "FaceError";

  /**
   * @param code the same as in the REST contract.
   * @param details measured values and limits, by what was measured.
   */
  constructor(
    readonly code: "no_face" | "multiple_faces" | "face_too_small" | "low_quality",
    message: string,
    readonly details: Readonly<Record<string, unknown>> = {},
  ) {
    super(message);
  }
}

/** No face was found. */
export class NoFace extends FaceError {
  override name = "NoFace";

  constructor() {
    super(
      "no_face",
      "No face was found: hold the photo upright, and come closer, until the face fills a good " +
        "part of it.",
    );
  }
}

/** More than one face that could be meant was found. */
export class MultipleFaces extends FaceError {
  override name = "MultipleFaces";

  constructor(faces: number, remedy: string) {
    super("multiple_faces", `The photo shows ${faces} faces${remedy}`, { faces });
  }
}

/** The face is too small in the photo. */
export class FaceTooSmall extends FaceError {
  override name = "FaceTooSmall";

  constructor(message: string, details: Readonly<Record<string, unknown>>) {
    super("face_too_small", message, details);
  }
}

/** The face was found and failed at least one limit of the quality gate. */
export class LowQuality extends FaceError {
  override name = "LowQuality";

  constructor(message: string, details: Readonly<Record<string, unknown>>) {
    super("low_quality", message, details);
  }
}
