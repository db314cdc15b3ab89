/** Which way up a photo is: as in `models/detection.py`, where the reasons stand. */

import { VeilfaceError } from "../errors.js";
import type { Detector, Size } from "./detection.js";
import type { Face } from "./faces.js";
import { resizeArea, type RgbImage } from "./image.js";

const SIDE = 64;

/** Quarter turns to the left that put the face of an aligned crop upright; 0 where it is. */
async function quarterTurns(detector: Detector, crop: RgbImage): Promise<number> {
  const small = resizeArea(crop, SIDE, SIDE);
  const [sheet, last] = [new Uint8Array(3 * (2 * SIDE) ** 2), SIDE - 1];
  for (let y = 0; y < SIDE; y++) {
    for (let x = 0; x < SIDE; x++) {
      const pixel = small.data.subarray(3 * (y * SIDE + x), 3 * (y * SIDE + x) + 3);
      const turned = [[x, y], [y, last - x], [last - x, last - y], [last - y, x]];
      turned.forEach(([column, row], quarter) => {
        const [right, down] = [quarter % 2, quarter >> 1];
        sheet.set(pixel, 3 * ((down * SIDE + row) * 2 * SIDE + right * SIDE + column));
      });
    }
  }
  const size: Size = detector.fixed ?? [2 * SIDE, 2 * SIDE];
  const image = { data: sheet, width: 2 * SIDE, height: 2 * SIDE };
  const scores = [0, 0, 0, 0];
  for (const { box, score } of await detector.detectOnce(image, size)) {
    const [x, y] = [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
    const quarter = Number(x >= SIDE) + 2 * Number(y >= SIDE);
    scores[quarter] = Math.max(scores[quarter], score);
  }
  return scores.indexOf(Math.max(...scores));
}

/** Refuse, by `low_quality`, a face that is upside down or lies on its side. */
export async function requireUpright(detector: Detector, face: Face, crop: RgbImage): Promise<void> {
  if (face.score >= detector.family.clearScore) return;
  const turns = await quarterTurns(detector, crop);
  if (turns === 0) return;
  const message = turns === 2 ? "The photo is upside down: turn it." : "The photo lies on its side: hold it upright.";
  throw new VeilfaceError("low_quality", message, { details: { turned: { value: 90 * turns, limit: 0 } } });
}
