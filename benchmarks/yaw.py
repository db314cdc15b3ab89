"""How often one photo is rejected by the yaw of the face, for what was enrolled.

The LFW people with more than three crops are enrolled on three frontal ones, or on two and a turned
one; every other crop of theirs is a probe. Crops are enlarged and given a border so that the pack's
detector finds the face; yaw is `models.quality.measure_pose`. Decoys are fitted to FairFace,
UTKFace and All-Age-Faces, adapted to photos of one half of the other people; the contract is
calibrated on the other half. Raw embeddings are compared with the mean of the three enrolled, at
the threshold of the same FMR.

Example
-------
::

    python -m benchmarks.yaw --data ../shared/data
"""

import argparse
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.operating_point import FACES, Array, calibrated, lfw, stored
from models.decoding import decode_image
from models.pack import ModelPack
from models.quality import measure_pose
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.distances import paired_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift
from verify import labelled_folder
from verify.metrics import rate
from verify.raw_pairs import impostor_cosines

ENROLLED = 3
FRONTAL, TURNED = 10.0, 20.0
BINS = (0, 10, 20, 30, 40, 91)
LEVELS = ("fmr-1e-3", "fmr-1e-4")
Indices = npt.NDArray[np.int64]


def yaw_of(pack: ModelPack, crop: npt.NDArray[np.uint8]) -> float:
    """Degrees, without sign; NaN where the detector finds no face."""
    large = cv2.resize(crop, (224, 224), interpolation=cv2.INTER_CUBIC)
    framed = np.asarray(cv2.copyMakeBorder(large, 48, 48, 48, 48, cv2.BORDER_CONSTANT), np.uint8)
    faces = pack.detect(framed)
    return abs(measure_pose(faces[0].keypoints)[0]) if faces else float("nan")


def enrolled_photos(rows: Indices, yaw: npt.NDArray[np.float64], *, turned: bool) -> Indices | None:
    """Return three photos of one person, in the folder's order; ``None`` where they lack."""
    sideways = rows[yaw[rows] >= TURNED][: 1 if turned else 0]
    frontal = rows[yaw[rows] < FRONTAL][: ENROLLED - len(sideways)]
    chosen = np.concatenate([frontal, sideways])
    wanted = len(sideways) == (1 if turned else 0)
    return chosen if wanted and len(chosen) == ENROLLED else None


def scores_of(
    contract: Contract, source: DecoyGenerator, enrolled: Array, probes: Array, owners: Indices
) -> npt.NDArray[np.float64]:
    """Scores of probes with the templates of their owners."""
    points, metric = source.project(probes), contract.calibration("p2s").metric
    with Keystream.seeded("yaw") as stream:
        templates = lift(
            source.project(enrolled),
            strategy=Strategy.ADVERSARIAL,
            m=contract.binding.m,
            source=source,
            stream=stream,
        )
    close = [
        similarity(paired_distances(points[part], templates[owners[part]], metric=metric))
        for part in np.array_split(np.arange(len(points)), max(1, len(points) // 200))
    ]
    means, spreads = contract.nobody(source).statistics(points, metric)
    return np.asarray((np.concatenate(close) - means) / spreads, dtype=np.float64)


def main() -> None:
    """Print one table for each kind of enrollment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--axes", type=int, default=228)
    parser.add_argument("--dim", type=int, default=112)
    parser.add_argument("--spared", type=int, default=600)
    parser.add_argument("--embeddings", type=Path, help="of the crops, embedded before")
    args = parser.parse_args()
    pack = ModelPack.load(args.data / "packs" / "w600k_mbf", threads=1)
    people, folder = (
        lfw(args.data, "w600k_mbf", args.embeddings),
        labelled_folder(args.data / "lfw/aligned112"),
    )
    crops = len(folder.paths)
    counts = np.bincount(people.person[:crops], minlength=people.person.max() + 1)
    rows = np.flatnonzero(counts[people.person[:crops]] > ENROLLED)
    yaw = np.full(crops, np.nan)
    for row in rows:
        yaw[row] = yaw_of(pack, decode_image(folder.paths[row].read_bytes()))
    print(f"{len(rows)} crops, no face found in {int(np.isnan(yaw[rows]).sum())}")

    measured = np.unique(people.person[rows])
    others = people[~people.of(measured)]
    single = np.random.default_rng(0).permutation(np.unique(others.person))
    decoys = others[others.of(single[: args.spared])]
    calibration = others[~others.of(single[: args.spared])]
    many = np.concatenate([stored(args.data, name, "w600k_mbf")[0] for name in FACES])
    names = [str(one) for one in decoys.person]
    source = DecoyGenerator.adapt(many, decoys.rows, names).reduced(args.axes)
    contract = calibrated(calibration, source, args.dim)
    raw = np.sort(
        impostor_cosines(calibration.rows, calibration.person, rng=np.random.default_rng(0))
    )

    groups = [rows[people.person[rows] == person] for person in measured]
    pairs = [[enrolled_photos(g, yaw, turned=turned) for turned in (False, True)] for g in groups]
    for title, kind, only_both in (
        ("three frontal", 0, False),
        ("three frontal, people who have a turned one too", 0, True),
        ("two frontal and one turned, the same people", 1, True),
    ):
        means: list[Array] = []
        probes: list[int] = []
        owners: list[int] = []
        for group, choice in zip(groups, pairs, strict=True):
            enrolled = choice[kind]
            if enrolled is None or (only_both and any(photos is None for photos in choice)):
                continue
            used = [photos for photos in choice if photos is not None] if only_both else [enrolled]
            left = np.setdiff1d(group, np.concatenate(used))
            left = left[~np.isnan(yaw[left])]
            probes += left.tolist()
            owners += [len(means)] * len(left)
            means.append(people.rows[enrolled].mean(axis=0))
        rows_enrolled = normalised(np.array(means)).astype(np.float32)
        whose = np.array(owners)
        scores = scores_of(contract, source, rows_enrolled, people.rows[probes], whose)
        cosines = np.sum(people.rows[probes] * rows_enrolled[whose], axis=1)
        print(f"\n{title}: {len(means)} people, {len(probes)} probes\n")
        print("| yaw of the probe | level | rejected | raw: rejected |\n|---|---|---|---|")
        for name in LEVELS:
            level = contract.calibration("p2s").level(name)
            limit = raw[-max(1, int((level.target_fmr or 0) * len(raw)))]
            for low, high in pairwise(BINS):
                here = (yaw[probes] >= low) & (yaw[probes] < high)
                cells = []
                for missed in (scores[here] < level.threshold, cosines[here] < limit):
                    seen = rate(int(missed.sum()), len(missed))
                    cells.append(
                        f"{seen.errors} / {seen.trials} = {100 * seen.value:.1f} % "
                        f"[{100 * seen.ci_low:.1f}, {100 * seen.ci_high:.1f}]"
                    )
                print(f"| {low}-{high}° | {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
