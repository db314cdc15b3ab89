"""How often two people get one enrollment that accepts both, and what genuine sets pay for it.

People of LFW with three photos or more. An attacker enrolls with the partner who is nearest: by one
photo of each of them, or by all photos that both have, with the two or three that pass best. Both
then come with a photo that was not enrolled. Beside that, morphs: the mean of two embeddings, and
of two aligned pictures, enrolled as a single photo.

Example
-------
::

    python -m benchmarks.two_people --data ../shared/data --pack w600k_mbf --dim 64
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from attacks.decisions import decide
from benchmarks.hostile_probes import Faces, contract_of
from models.extraction import Extractor
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from templates.space.agreement import InconsistentImages, mean_embedding, weakest_split
from templates.space.lifting import lift
from verify import labelled_folder
from verify.metrics import rate

ATTACKERS = 200
MOST_PHOTOS = 5
SHORTLIST = 8
"""Partners of whom all sets are tried, by the nearest photo."""


@dataclass(frozen=True)
class Attempt:
    """Photos of two people, enrolled together, and the one that each of them comes with."""

    enrolled: tuple[int, ...]
    fresh: tuple[int, int]


def photos_of(faces: Faces, *, least: int = 3, most: int = MOST_PHOTOS) -> list[NDArray[np.int64]]:
    """Positions of the photos of everybody who has as many."""
    of = [np.flatnonzero(faces.names == name)[:most] for name in np.unique(faces.names)]
    return [rows for rows in of if len(rows) >= least]


def by_one_photo(faces: Faces, people: Sequence[NDArray[np.int64]]) -> list[Attempt]:
    """Everybody with the partner whose first photo is nearest to their own first."""
    firsts = np.array([rows[0] for rows in people])
    cosines = faces.descriptors[firsts] @ faces.descriptors[firsts].T
    np.fill_diagonal(cosines, -1)
    return [
        Attempt((int(rows[0]), int(people[other][0])), (int(rows[-1]), int(people[other][-1])))
        for rows, other in zip(people, cosines.argmax(axis=1).tolist(), strict=True)
    ]


def by_all_photos(
    faces: Faces, people: Sequence[NDArray[np.int64]], *, own: int, others: int
) -> list[Attempt]:
    """Everybody with the partner and the photos that agree best; both keep one photo back."""
    known = [rows[:-1] for rows in people]
    attempts = []
    for place, rows in enumerate(known):
        if len(rows) < own:
            continue
        nearest = np.array(
            [
                -1.0
                if other == place or len(of) < others
                else float((faces.descriptors[rows] @ faces.descriptors[of].T).max())
                for other, of in enumerate(known)
            ]
        )
        best, chosen = -2.0, None
        for other in np.argsort(-nearest)[:SHORTLIST].tolist():
            for own_photos in combinations(rows.tolist(), own):
                for others_photos in combinations(known[other].tolist(), others):
                    agreement = weakest_split(
                        faces.descriptors[[*own_photos, *others_photos]]
                    ).agreement
                    if agreement > best:
                        fresh = (int(people[place][-1]), int(people[other][-1]))
                        best, chosen = agreement, Attempt((*own_photos, *others_photos), fresh)
        if chosen is not None:
            attempts.append(chosen)
    return attempts


def enrolled_means(
    faces: Faces, attempts: Sequence[Attempt], contract: Contract
) -> tuple[list[Attempt], NDArray[np.float32]]:
    """Attempts that are not refused, and the embeddings that are enrolled for them."""
    passed, means = [], []
    for attempt in attempts:
        rows = faces.descriptors[list(attempt.enrolled)]
        try:
            means.append(mean_embedding(rows, consistency=contract.photo_consistency))
        except InconsistentImages:
            continue
        passed.append(attempt)
    return passed, np.array(means, dtype=np.float32).reshape(len(means), contract.binding.n)


def both_accepted(
    faces: Faces,
    attempts: Sequence[Attempt],
    means: NDArray[np.float32],
    contract: Contract,
    source: DecoyGenerator,
) -> int:
    """Number of templates of these means that accept both, at the default level."""
    if not attempts:
        return 0
    with Keystream.seeded("two people") as stream:
        templates = lift(
            means,
            strategy=contract.binding.strategy,
            m=contract.binding.m,
            source=source,
            stream=stream,
        )
    calibration = contract.calibration("p2s")
    level = calibration.level(contract.default_level)
    accepted = [
        decide(
            faces.descriptors[[attempt.fresh[side] for attempt in attempts]],
            templates, contract, calibration, level, paired=True,
        )
        for side in (0, 1)
    ]  # fmt: skip
    return int(np.count_nonzero(accepted[0] & accepted[1]))


def refused_genuine(faces: Faces, contract: Contract, *, photos: int) -> tuple[int, int]:
    """Genuine enrollments on everybody's first photos that are refused, of how many."""
    sets = [rows[:photos] for rows in photos_of(faces, least=photos)]
    limit = contract.photo_consistency
    refused = [weakest_split(faces.descriptors[rows]).agreement < limit for rows in sets]
    return sum(refused), len(sets)


def embedded(pack: ModelPack, root: Path, *, aligned: bool) -> tuple[Faces, list[Path]]:
    """Embed a labelled folder."""
    folder = labelled_folder(root)
    name_of = dict(zip(folder.paths, folder.identities, strict=True))
    extraction = Extractor(pack, aligned=aligned).extract(folder.paths)
    names = np.array([name_of[path] for path in extraction.paths])
    return Faces(extraction.descriptors, names), list(extraction.paths)


def blends(
    pack: ModelPack, paths: Sequence[Path], attempts: Sequence[Attempt]
) -> NDArray[np.float32]:
    """Embed the mean picture of two aligned ones; they need no warping, as eyes meet eyes."""

    def picture(index: int) -> NDArray[np.float64]:
        with Image.open(paths[index]) as image:
            return np.asarray(image.convert("RGB"), dtype=np.float64)

    return np.concatenate(
        [
            pack.embed(np.round(sum(picture(i) for i in attempt.enrolled) / 2)[None].astype("u1"))
            for attempt in attempts
        ]
    )


def morphs(
    pack: ModelPack,
    faces: Faces,
    paths: Sequence[Path],
    attempts: Sequence[Attempt],
    contract: Contract,
    source: DecoyGenerator,
) -> dict[str, int]:
    """Templates of one 50/50 morph each that accept both people."""
    mean = np.stack([faces.descriptors[list(a.enrolled)].mean(axis=0) for a in attempts])
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    made = {"mean of the embeddings": mean, "blend": blends(pack, paths, attempts)}
    return {
        name: both_accepted(faces, attempts, rows, contract, source) for name, rows in made.items()
    }


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with packs/ and lfw/")
    parser.add_argument("--pack", default="w600k_mbf")
    parser.add_argument("--dim", type=int, default=64)
    args = parser.parse_args()
    pack = ModelPack.load(args.data / "packs" / args.pack)
    crops, paths = embedded(pack, args.data / "lfw" / "aligned112", aligned=True)
    people, _ = embedded(pack, args.data / "lfw" / "photos", aligned=False)
    counts = {name: int(np.count_nonzero(crops.names == name)) for name in set(crops.names)}
    chance = np.random.default_rng(0)
    several = chance.permutation(sorted(name for name in counts if counts[name] >= 3))
    known = set(people.names)
    # Attackers choose partners among half of the people, the other half calibrates.
    half = len(several) // 2
    attacking = np.isin(crops.names, several[:half])
    single = np.array([counts[name] == 1 and name not in known for name in crops.names])
    calibrating = np.isin(crops.names, [name for name in several[half:] if name not in known])
    source = DecoyGenerator.fit(crops.descriptors[single])
    contract = contract_of(crops.only(calibrating), source, args.dim, (0,))
    print(f"photo consistency {contract.photo_consistency:.3f}, {contract.recorded}")
    attackers = crops.only(attacking)
    own_paths = [path for path, kept in zip(paths, attacking, strict=True) if kept]
    for name, faces in (("crops", attackers), ("photos", people)):
        rows = photos_of(faces)
        ways: dict[str, Callable[[], list[Attempt]]] = {
            "one photo": partial(by_one_photo, faces, rows),
            **{
                f"all photos, {own} + {others}": partial(
                    by_all_photos, faces, rows, own=own, others=others
                )
                for own, others in ((1, 1), (2, 1), (2, 2))
            },
        }
        for way, made in ways.items():
            attempts = made()[:ATTACKERS]
            passed, means = enrolled_means(faces, attempts, contract)
            both = both_accepted(faces, passed, means, contract, source)
            trials = len(attempts)
            print(json.dumps({"people": name, "nearest by": way, "attempts": trials,
                              "enrolled": len(passed), "both": both}))  # fmt: skip
        for photos in (2, 3):
            refused, trials = refused_genuine(faces, contract, photos=photos)
            print(json.dumps({"people": name, "genuine sets of": photos, "refused": refused,
                              "rate": rate(refused, trials).to_json()}))  # fmt: skip
    nearest = by_one_photo(attackers, photos_of(attackers))
    others = chance.permutation(len(nearest))
    strangers = [
        Attempt((one.enrolled[0], nearest[i].enrolled[0]), (one.fresh[0], nearest[i].fresh[0]))
        for one, i in zip(nearest, others.tolist(), strict=True)
        if one.enrolled[0] != nearest[i].enrolled[0]
    ]
    for name, attempts in (("nearest", nearest[:ATTACKERS]), ("random", strangers[:ATTACKERS])):
        counted = morphs(pack, attackers, own_paths, attempts, contract, source)
        print(json.dumps({"morph with": name, "of": len(attempts), **counted}))


if __name__ == "__main__":
    main()
