"""What detection makes of photos that a face fills: one canvas against the canvas for each face.

Every photo of a folder of people (`Name/Name_0001.jpg`) is cropped around its face, squeezed, put
into a black border, and given a small second face in a corner, at its own size and enlarged. Two
rules look at each picture in turn, in one process: one canvas of 640 with a look at 320 and into
a border when nothing is found, and `models.detection.find_faces`. An embedding is compared with
that of the same pixels, cropped by the points that the whole photo gave at 320: it differs by the
detection alone.

Example
-------
::

    python -m benchmarks.tight_photos --photos FOLDER --pack PACK
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from models.alignment import align
from models.boxes import Face, ranked
from models.decoding import decode_image
from models.detection import NEAR_SIZE, RETRY_BORDER, Detector, find_faces
from models.errors import FaceError
from models.pack import ModelPack
from models.quality import DEFAULT_QUALITY, check, measure
from models.selection import FacePolicy, select_face

Picture = NDArray[np.uint8]
Points = NDArray[np.float32]
Rule = Callable[[Detector, Picture], list[Face]]

WRONG = 0.5  # cosine to the right crop below which the embedding is of something else
OFF = 0.95
CROPS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.55)
LARGE = 960


def one_canvas(detector: Detector, image: Picture) -> list[Face]:
    """Look at the main canvas, and elsewhere only when nothing is found on it."""
    near = (NEAR_SIZE, NEAR_SIZE)
    faces = detector.detect_once(image, detector.sizes[0]) or detector.detect_once(image, near)
    if faces:
        return faces
    top, left = (round(side * RETRY_BORDER) for side in image.shape[:2])
    wide = cv2.copyMakeBorder(image, top, top, left, left, cv2.BORDER_CONSTANT)
    offset = np.array([left, top], dtype=np.float32)
    return [
        Face(face.box - np.tile(offset, 2), face.score, face.keypoints - offset)
        for face in detector.detect_once(np.asarray(wide, np.uint8), detector.sizes[0])
    ]


@dataclass
class Tally:
    """What one rule made of one kind of picture."""

    cosines: list[float] = field(default_factory=list)
    refusals: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    seconds: list[float] = field(default_factory=list)


def main() -> None:
    """Print one row for each kind of picture and rule."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--pack", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1, help="take every n-th photo")
    options = parser.parse_args()
    pack = ModelPack.load(options.pack, threads=1)
    detector = pack._detector
    assert detector is not None, "the pack has no detector"
    photos = [
        decode_image(path.read_bytes())
        for path in sorted(options.photos.glob("*/*.jpg"))[:: options.every]
    ]
    rules: dict[str, Rule] = {"one canvas": one_canvas, "by size": find_faces}
    tallies: dict[tuple[str, str], Tally] = defaultdict(Tally)
    passes: dict[str, list[float]] = defaultdict(list)
    for kind, picture, points in pictures(detector, photos):
        started = time.process_time()
        detector.detect_once(picture, detector.sizes[0])
        passes[kind].append(time.process_time() - started)
        for name, rule in rules.items():
            tally = tallies[kind, name]
            started = time.process_time()
            faces = ranked(rule(detector, picture), picture.shape)
            tally.seconds.append(time.process_time() - started)
            judge(pack, picture, points, faces, tally)
    print(f"{'picture':24}{'rule':12}{'n':>5}{'off %':>7}{'wrong %':>8}{'none %':>7}", end="")
    print(f"{'refused %':>10}  {'cost':>5}  what the gate said wrongly")
    for (kind, name), tally in tallies.items():
        cosines = np.array(tally.cosines)
        count = len(cosines)
        acquired = cosines[~np.isnan(cosines)]
        rates = [(acquired < OFF).sum(), (acquired < WRONG).sum(), np.isnan(cosines).sum()]
        refused = sum(tally.refusals.values())
        print(f"{kind:24}{name:12}{count:5d}", end="")
        for rate, width in zip(rates, (7, 8, 7), strict=True):
            print(f"{100 * rate / count:{width}.1f}", end="")
        ratio = sum(tally.seconds) / sum(passes[kind])
        print(f"{100 * refused / count:10.1f}  {ratio:5.2f}  {dict(tally.refusals)}")
    for name in rules:
        spent = sum(sum(t.seconds) for (_, rule), t in tallies.items() if rule == name)
        print(f"{name}: {spent / sum(map(sum, passes.values())):.3f} of one pass over all pictures")


def judge(
    pack: ModelPack, picture: Picture, points: Points, faces: list[Face], tally: Tally
) -> None:
    """Book the embedding's cosine to the right one, and what the gate refuses wrongly."""
    right = align(picture, points, size=pack.crop_size)
    if not faces:
        tally.cosines.append(float("nan"))
    else:
        taken = max(faces, key=lambda face: face.area)
        rows = pack.embed(np.stack([right, pack.align(picture, taken)]))
        tally.cosines.append(float(rows[0] @ rows[1]))
    try:
        main_face = select_face(
            faces,
            FacePolicy.DOMINANT,
            shape=picture.shape,
            min_size=DEFAULT_QUALITY.min_face_size,
        )
        crop = pack.align(picture, main_face)
        check(measure(crop, main_face, picture), recommended_score=0.0)
    except FaceError as error:
        tally.refusals[error.code] += 1


def pictures(detector: Detector, photos: list[Picture]) -> Iterator[tuple[str, Picture, Points]]:
    """Kind, picture and the points of the face that it is about."""
    alone = list(single_faces(detector, photos))
    for index, (photo, face) in enumerate(alone):
        stranger, other = alone[(index + 1) % len(alone)]
        patch = cut(stranger, other, margin=0.15)[0]
        patch = scaled(patch, 96 / max(patch.shape[:2]))
        yield "photo as it is", photo, face.keypoints
        for crop in CROPS:
            # 0: the face with half of its size around it; 50 %: the box of the face alone.
            tight, points = cut(photo, face, margin=0.5 - crop)
            yield f"crop {100 * crop:.0f} %", tight, points
            factor = LARGE / max(tight.shape[:2])
            large, points = scaled(tight, factor), points * np.float32(factor)
            yield f"crop {100 * crop:.0f} %, enlarged", large, points
            if crop in (0.3, 0.5):
                edge = LARGE // 12
                framed = cv2.copyMakeBorder(large, edge, edge, edge, edge, cv2.BORDER_CONSTANT)
                yield f"crop {100 * crop:.0f} %, bordered", np.asarray(framed), points + edge
                pasted = large.copy()
                down, across = index % 2, index // 2 % 2
                y, x = (large.shape[0] - 96) * down, (large.shape[1] - patch.shape[1]) * across
                pasted[y : y + len(patch), x : x + patch.shape[1]] = patch
                yield f"crop {100 * crop:.0f} %, second face", pasted, points
    for photo, face in single_faces(detector, [scaled(photo, 0.6, 1.0) for photo in photos]):
        for crop in (0.3, 0.5):
            tight, points = cut(photo, face, margin=0.5 - crop)
            yield f"crop {100 * crop:.0f} %, squeezed", tight, points


def single_faces(detector: Detector, photos: Iterable[Picture]) -> Iterator[tuple[Picture, Face]]:
    """Photos that show one face: with a second one, what is right depends on the crop."""
    for photo in photos:
        faces = detector.detect_once(photo, (NEAR_SIZE, NEAR_SIZE))
        if len(faces) == 1:
            yield photo, faces[0]


def cut(photo: Picture, face: Face, *, margin: float) -> tuple[Picture, Points]:
    """Cut out a face with a margin, a share of its longer side; and its points in the cut."""
    reach = margin * max(face.width, face.height)
    limits = np.tile(photo.shape[1::-1], 2)
    box = np.clip(face.box + np.array([-reach, -reach, reach, reach]), 0, limits)
    x1, y1, x2, y2 = box.astype(int)
    moved = face.keypoints - np.array([x1, y1], np.float32)
    return np.ascontiguousarray(photo[y1:y2, x1:x2]), moved


def scaled(image: Picture, across: float, down: float | None = None) -> Picture:
    """Resize a picture by one factor or by two."""
    height, width = image.shape[:2]
    size = (max(1, round(width * across)), max(1, round(height * (down or across))))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)


if __name__ == "__main__":
    main()
