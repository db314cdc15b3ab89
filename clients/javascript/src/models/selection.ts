/** Which face of a photo is meant, where it shows several. */

import { boxArea, shorterSide, type Face } from "./boxes.js";
import { MultipleFaces, NoFace } from "./errors.js";

// As in `models/selection.py`.
const DOMINANCE = 2;
const LARGER = 1.25;

/**
 * What a photo with several faces means.
 *
 * `dominant` is the largest face, where it covers the middle of the picture and has at least twice
 * the area of every other; `largest` the largest wherever it is, where it has 1.25 times the area;
 * `single` none of them.
 */
export type FacePolicy = "dominant" | "largest" | "single";

const REMEDIES: Readonly<Record<FacePolicy, string>> = {
  dominant:
    ", and none of them is both in the middle and much the largest: come closer, or send " +
    "face=largest to take the largest face wherever it is.",
  largest: ", and the largest two are of about the same size: cut the photo to one.",
  single: "; send one that shows a single face.",
};

/**
 * The face that is meant.
 *
 * @param size width and height of the picture.
 * @param least shorter side of the box from which a face counts.
 */
export function selectFace(
  faces: readonly Face[],
  policy: FacePolicy,
  { width, height }: { readonly width: number; readonly height: number },
  least: number,
): Face {
  if (faces.length === 0) throw new NoFace();
  const byArea = [...faces].sort((a, b) => boxArea(b.box) - boxArea(a.box));
  const counted = byArea.filter((face) => shorterSide(face) >= least);
  const [main, other] = counted.length > 0 ? counted : byArea.slice(0, 1);
  if (other === undefined) return main;
  const [x1, y1, x2, y2] = main.box;
  const coversMiddle = x1 <= width / 2 && width / 2 <= x2 && y1 <= height / 2 && height / 2 <= y2;
  const ratio = boxArea(main.box) / boxArea(other.box);
  if (policy === "dominant" && ratio >= DOMINANCE && coversMiddle) return main;
  if (policy === "largest" && ratio >= LARGER) return main;
  throw new MultipleFaces(counted.length, REMEDIES[policy]);
}
