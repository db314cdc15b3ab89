"""How often one photo is rejected by the yaw of the face, for what was enrolled.

The LFW people with more than three crops are enrolled on three frontal ones, or on two and a turned
one; every other crop of theirs is a probe. Crops are enlarged and given a border so that the pack's
detector finds the face; yaw is `models.quality.measure_pose`. Everybody else's crops, and further
photos of LFW, make the decoys (one half of these people) and calibrate (the other half). Raw
embeddings are compared with the mean of the three enrolled, at a threshold of the same FMR on such
means of the people of the calibration. Intervals take a person's photos as independent: they are
somewhat too narrow.

Example
-------
::

    python -m benchmarks.yaw --data ../shared/data
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from attacks.decisions import decide
from benchmarks.hostile_probes import Faces, Floats, contract_of, lifted, read_npz
from models.decoding import decode_image
from models.extraction import Extractor
from models.pack import ModelPack
from models.quality import DEFAULT_QUALITY, measure_pose
from templates.decoys import NOISE_ENERGY, DecoyGenerator
from templates.space.embedding import normalised
from verify import labelled_folder
from verify.metrics import threshold_at_fmr, wilson

ENROLLED = 3
FRONTAL, TURNED = 10.0, 20.0
BINS = 6
LEVELS = (("fmr-1e-3", 1e-3), ("fmr-1e-4", 1e-4))
Indices = npt.NDArray[np.int64]


def yaw_of(pack: ModelPack, crop: npt.NDArray[np.uint8]) -> float:
    """Degrees, without sign; NaN where the detector finds no face."""
    large = cv2.resize(crop, (224, 224), interpolation=cv2.INTER_CUBIC)
    framed = np.asarray(cv2.copyMakeBorder(large, 48, 48, 48, 48, cv2.BORDER_CONSTANT), np.uint8)
    faces = pack.detect(framed)
    return abs(measure_pose(faces[0].keypoints)[0]) if faces else float("nan")


def enrolled_photos(rows: Indices, yaw: npt.NDArray[np.float64], *, turned: bool) -> Indices | None:
    """Return three photos of one person, in the folder's order; ``None`` where they lack."""
    frontal = rows[yaw[rows] < FRONTAL]
    sideways = rows[yaw[rows] >= TURNED]
    if turned:
        frontal, sideways = frontal[: ENROLLED - 1], sideways[:1]
    else:
        frontal, sideways = frontal[:ENROLLED], sideways[:0]
    chosen = np.concatenate([frontal, sideways])
    return chosen if len(chosen) == ENROLLED else None


def shown(missed: npt.NDArray[np.bool_]) -> str:
    """Count, share and Wilson interval."""
    if not len(missed):
        return "none"
    low, high = wilson(int(missed.sum()), len(missed))
    return (
        f"{missed.sum()} / {len(missed)} = {100 * missed.mean():.1f} %"
        f" [{100 * low:.1f}, {100 * high:.1f}]"
    )


def main() -> None:
    """Print one table for each kind of enrollment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--dim", type=int, default=160)
    args = parser.parse_args()
    pack = ModelPack.load(args.data / "packs" / "w600k_mbf", threads=1)
    folder = labelled_folder(args.data / "lfw" / "aligned112")
    names = np.array(folder.identities)
    people, counts = np.unique(names, return_counts=True)
    several = np.isin(names, people[counts > ENROLLED])
    paths = [path for path, kept in zip(folder.paths, several, strict=True) if kept]
    names = names[several]
    crops = [decode_image(path.read_bytes()) for path in paths]
    yaw = np.array([yaw_of(pack, crop) for crop in crops])
    lost = int(np.isnan(yaw).sum())
    print(f"{len(crops)} crops of {len(np.unique(names))} people, no face found in {lost}")
    embedded = Extractor(pack, aligned=True).extract(folder.paths).descriptors
    assert len(embedded) == len(folder.paths), "an aligned crop is always embedded"
    rows = embedded[several]

    rest = read_npz(args.data / "embeddings" / "lfw_rest.npz")
    others = Faces(
        np.concatenate([rest.descriptors, embedded]),
        np.concatenate([rest.names, folder.identities]),
    )
    others = others.only(~np.isin(others.names, names))
    strangers = np.random.default_rng(0).permutation(np.unique(others.names))
    half = np.isin(others.names, strangers[: len(strangers) // 2])
    noise = NOISE_ENERGY / pack.info.n
    source = DecoyGenerator.fit(others.only(half).descriptors, noise=noise)
    calibrating = others.only(~half)
    print(f"decoys of {half.sum()} photos, calibration on {(~half).sum()}", flush=True)
    contract = contract_of(calibrating, source, args.dim, [0])
    calibration = contract.calibration("p2s")
    enrolled_others, probes_of_others, whose = calibrating.split(ENROLLED)
    cosines = probes_of_others @ enrolled_others.T
    impostor = cosines[whose[:, None] != np.arange(len(enrolled_others))]

    groups = [np.flatnonzero(names == name) for name in np.unique(names)]
    pairs = [[enrolled_photos(g, yaw, turned=turned) for turned in (False, True)] for g in groups]
    both = [one is not None and other is not None for one, other in pairs]
    for title, kind, only_both in (
        ("three frontal", 0, False),
        ("three frontal, people who have a turned one too", 0, True),
        ("two frontal and one turned, the same people", 1, True),
    ):
        means: list[Floats] = []
        probes: list[int] = []
        owners: list[int] = []
        for group, choice, has_both in zip(groups, pairs, both, strict=True):
            enrolled = choice[kind]
            if enrolled is None or (only_both and not has_both):
                continue
            used = [photos for photos in choice if photos is not None] if only_both else [enrolled]
            left = np.setdiff1d(group, np.concatenate(used))
            left = left[~np.isnan(yaw[left])]
            probes += left.tolist()
            owners += [len(means)] * len(left)
            means.append(rows[enrolled].mean(axis=0))
        enrolled_rows = normalised(np.array(means)).astype(np.float32)
        templates = lifted(enrolled_rows, source, args.dim, "yaw")
        taken = rows[probes]
        own = (taken * enrolled_rows[owners]).sum(axis=1)
        print(f"\n{title}: {len(means)} people, {len(probes)} probes\n")
        print("| yaw of the probe | level | rejected | raw: rejected | people |")
        print("|---|---|---|---|---|")
        for name, target in LEVELS:
            level = calibration.level(name)
            accepted = decide(
                taken, templates[np.array(owners)], contract, calibration, level, paired=True
            )
            raw = own < threshold_at_fmr(impostor, target)
            for low in range(0, 10 * BINS, 10):
                high = low + 10 if low < 10 * (BINS - 1) else 91
                here = (yaw[probes] >= low) & (yaw[probes] < high)
                count = len(np.unique(np.array(owners)[here]))
                print(
                    f"| {low}-{high}° | {name} | {shown(~accepted[here])} | {shown(raw[here])}"
                    f" | {count} |",
                    flush=True,
                )
    refused = int((yaw > DEFAULT_QUALITY.max_yaw).sum())
    print(f"\nabove the gate's {DEFAULT_QUALITY.max_yaw:.0f}°: {refused} of {len(yaw) - lost}")


if __name__ == "__main__":
    main()
