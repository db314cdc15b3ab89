"""What several photos of a probe are worth, and whether weights by quality would add to it.

The 80 people of LFW with five photos. All ways to enroll two of a person's photos and verify by the
other three; each probe meets all 80 templates. The score is the similarity less its mean over the
templates of the 79 others, in their standard deviations; thresholds are the quantiles of those
others. Decoys are drawn from a generator of 1,000 other people. One run compares the mean of the
three photos with weighted ones, and with one of the three; or, with ``--probe-dims``, the mean and
the one as photos and lifted, as the private clients send them.

Example
-------
::

    python -m benchmarks.probe_photos --data ../shared/data --pack w600k_mbf --dim 64
    python -m benchmarks.probe_photos --data ../shared/data --dim 192 --probe-dims 2,4
"""

import argparse
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.extraction import Extractor
from models.pack import ModelPack
from models.quality import Quality
from templates.decoys import DecoyGenerator
from templates.distances import Metric, pairwise_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

PHOTOS = 5
ENROLLED = 2
FMRS = (1e-3, 1e-4)
DECOY_FACES = 1000


def weights_of(qualities: list[Quality]) -> dict[str, NDArray[np.float64]]:
    """Candidate weights of photos, by what the quality gate measures."""
    score = np.array([quality.score for quality in qualities], dtype=np.float64)
    sharpness = np.clip([quality.sharpness for quality in qualities], 0.5, 6.0)
    yaw = np.array([quality.yaw for quality in qualities], dtype=np.float64)
    frontal = np.cos(np.radians(np.clip(np.abs(yaw), 0, 80)))
    return {
        "plain mean": np.ones(len(qualities)),
        "detector's score": score,
        "sharpness": sharpness,
        "root of sharpness": np.sqrt(sharpness),
        "cosine of yaw": frontal,
        "cosine of yaw, squared": frontal**2,
        "cosine of yaw × root of sharpness": frontal * np.sqrt(sharpness),
    }


def mean_of(
    rows: NDArray[np.float32], places: NDArray[np.int64], weights: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Weighted means of the photos at ``places`` (people, k), normalised: (people, n)."""
    mean = (rows[places] * weights[places][..., None]).sum(axis=1)
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True), dtype=np.float32)


def scores(similarities: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scores of the probes (rows) against their own template, and against the others' (columns)."""
    others = ~np.eye(len(similarities), dtype=bool)
    rest = similarities[others].reshape(len(similarities), -1)
    mean, spread = rest.mean(axis=1, keepdims=True), rest.std(axis=1, keepdims=True)
    return (np.diag(similarities) - mean[:, 0]) / spread[:, 0], ((rest - mean) / spread).ravel()


def main() -> None:
    """Print one line for each way to average."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--pack", default="w600k_mbf")
    parser.add_argument("--dim", type=int, default=64)
    parser.add_argument("--probe-dims", default="", help="of lifted probes, such as 2,4")
    options = parser.parse_args()
    probe_dims = [int(each) for each in options.probe_dims.split(",") if each]
    pack = ModelPack.load(options.data / "packs" / options.pack, threads=1)
    folders = sorted(path for path in (options.data / "lfw" / "photos").iterdir() if path.is_dir())
    samples = [
        pack.embed_photo(photo.read_bytes(), policy=None, quality=None)
        for folder in folders
        for photo in sorted(folder.glob("*.jpg"))[:PHOTOS]
    ]
    rows = np.stack([sample.embedding for sample in samples])
    people = np.arange(len(rows)).reshape(len(folders), PHOTOS)
    names = {folder.name for folder in folders}
    crops = (options.data / "lfw" / "aligned112").glob("*/*_0001.jpg")
    others = sorted(crop for crop in crops if crop.parent.name not in names)[:DECOY_FACES]
    source = DecoyGenerator.fit(Extractor(pack, aligned=True).extract(others).descriptors)
    weights = weights_of([sample.quality for sample in samples])
    if probe_dims:
        weights = {"plain mean": weights["plain mean"]}

    found: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for split in combinations(range(PHOTOS), ENROLLED):
        rest = [place for place in range(PHOTOS) if place not in split]
        enrolled = mean_of(rows, people[:, list(split)], weights["plain mean"])
        with Keystream.seeded("probe photos", str(split)) as stream:
            lifted = partial(lift, strategy=Strategy.ADVERSARIAL, source=source, stream=stream)
            templates = lifted(enrolled, m=options.dim)
            points = {name: mean_of(rows, people[:, rest], each) for name, each in weights.items()}
            points["one photo"] = rows[people[:, rest[0]]]
            probes: dict[str, NDArray[np.float32] | SubspaceBatch] = {**points}
            for m in probe_dims:
                probes |= {f"{name}, m = {m}": lifted(each, m=m) for name, each in points.items()}
        for name, probe in probes.items():
            distances = pairwise_distances(probe, templates, metric=Metric.SPHERICAL)
            similarities = np.asarray(similarity(distances), dtype=np.float64)
            found.setdefault(name, []).append(scores(similarities))
    for name, parts in found.items():
        genuine, impostor = (np.concatenate(each) for each in zip(*parts, strict=True))
        apart = (genuine.mean() - impostor.mean()) / np.sqrt((genuine.var() + impostor.var()) / 2)
        rejected = [int((genuine < np.quantile(impostor, 1 - fmr)).sum()) for fmr in FMRS]
        print(
            f"{name:34} d′ {apart:.3f}, score of the lowest 2 % {np.quantile(genuine, 0.02):.2f}, "
            f"rejected at FMR 1e-3 and 1e-4: {rejected[0]} and {rejected[1]} of {len(genuine)}"
        )


if __name__ == "__main__":
    main()
