"""False match rates of strangers of one age, at the levels of a contract calibrated on LFW.

LFW shows adults. Photos of `embeddings/utkface.npz` (the age stands first in the name) and of
`embeddings/allagefaces.npz` (behind the `A`; each photo another person) are enrolled one by one,
and compared with the others of their age. Decoys are fitted to `embeddings/fairface_more.npz` and
adapted, as `veilface setup` does, to people of `embeddings/lfw_rest.npz` with one photo each; the
contract is calibrated on its other people.

Example
-------
::

    python -m benchmarks.ages --data ../shared/data --dim 160
"""

import argparse
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from api.process.preparation import LikeSample, binding_for, make_generator
from models.extraction import Extraction
from models.pack import ModelPack
from templates.distances import pairwise_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from verify import CalibrationOptions, calibrate
from verify.evaluation.labels_file import YEARS, age_group

LEVELS = ("fmr-1e-3", "fmr-1e-4")
MOST = 400
TILE = 100


def read(file: Path, name: str = "emb_mbf") -> tuple[list[str], NDArray[np.float32]]:
    """Paths and unit rows of a file of embeddings."""
    with np.load(file) as archive:
        rows = archive[name].astype(np.float32)
        return archive["paths"].tolist(), rows / np.linalg.norm(rows, axis=1, keepdims=True)


def age_of(path: str) -> int:
    """Age in years that a file's name states."""
    match = re.match(r"(\d+)_|\d+A(\d+)\.", path)
    assert match is not None, path
    return int(match[1] or match[2])


def extraction(paths: list[str], rows: NDArray[np.float32]) -> Extraction:
    """Embeddings as bulk extraction gives them."""
    return Extraction(rows, [Path(path) for path in paths], [], cached=0)


def main() -> None:
    """Calibrate, and print a row for each age of each set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--dim", type=int, default=96)
    parser.add_argument("--axes", type=int, default=224)
    parser.add_argument("--adapt", type=int, default=600, help="photos of LFW for the decoys")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    folder = options.data / "embeddings"
    pack = ModelPack.load(options.data / "packs" / "w600k_mbf", threads=1)
    paths, people = read(folder / "lfw_rest.npz")
    names = np.array([path.partition("/")[0] for path in paths])
    counts = dict(zip(*np.unique(names, return_counts=True), strict=True))
    like = np.flatnonzero([counts[name] == 1 for name in names])[: options.adapt]
    rest = np.setdiff1d(np.arange(len(names)), like)
    adapted = LikeSample(
        extraction([paths[row] for row in like], people[like]), names[like].tolist()
    )
    source = make_generator(
        extraction(*read(folder / "fairface_more.npz")),
        pack,
        like=adapted if len(like) else None,
    ).reduced(options.axes)
    contract = calibrate(
        people[rest],
        names[rest].tolist(),
        binding=binding_for(pack, source, strategy=Strategy.ADVERSARIAL, m=options.dim),
        source=source,
        options=CalibrationOptions(
            probe_photos=(1,), most_cells=2_000_000, most_templates=1_000, seed=options.seed
        ),
    ).contract
    calibration, nobody = contract.calibration("p2s"), contract.nobody(source)
    rng = np.random.default_rng(options.seed)
    print(f"| set | age | people | {' | '.join(LEVELS)} |\n|{'---|' * (3 + len(LEVELS))}")
    for name in ("utkface", "allagefaces"):
        paths, rows = read(folder / f"{name}.npz")
        groups = np.array([age_group(age_of(path)) for path in paths])
        for group in map(age_group, YEARS):
            chosen = rng.permutation(np.flatnonzero(groups == group))[:MOST]
            if len(chosen) < 50:
                continue
            probes = source.project(rows[chosen])
            scores = np.empty((len(probes), len(probes)), np.float32)
            means, spreads = nobody.statistics(probes, calibration.metric)
            for start in range(0, len(probes), TILE):
                with Keystream.seeded(name, group, start, options.seed) as stream:
                    templates = lift(
                        probes[start : start + TILE],
                        strategy=Strategy.ADVERSARIAL,
                        m=options.dim,
                        source=source,
                        stream=stream,
                    )
                distances = pairwise_distances(probes, templates, metric=calibration.metric)
                scores[:, start : start + TILE] = (
                    similarity(distances) - means[:, None]
                ) / spreads[:, None]
            others = scores[~np.eye(len(scores), dtype=bool)]
            cells = []
            for level in LEVELS:
                matches = int((others >= calibration.level(level).threshold).sum())
                cells.append(f"{100 * matches / len(others):.3f} % ({matches:,}/{len(others):,})")
            print(f"| {name} | {group} | {len(probes)} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
