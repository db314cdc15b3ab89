"""What raw descriptors tell before any is lifted: photo consistency, and mislabelled people."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.errors import ContractError

TILE = 1024
MOST_PHOTOS = 8_000
MOST_PAIRS = 50


@dataclass(frozen=True)
class SuspiciousPair:
    """Two people whose photos are so alike that they may be one person under two names."""

    first: str
    second: str
    cosine: float


def impostor_cosines(
    descriptors: NDArray[np.float32], person_of: NDArray[np.int64], *, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Raw cosines of all pairs of photos of different people.

    Of more than ``MOST_PHOTOS`` photos a random subset of that many is compared, so that memory
    stays below 0.3 GiB.

    Raises
    ------
    ContractError
        Where there is no such pair.
    """
    if len(descriptors) > MOST_PHOTOS:
        kept = rng.choice(len(descriptors), MOST_PHOTOS, replace=False)
        descriptors, person_of = descriptors[kept], person_of[kept]
    cosines = [tile[mask] for _, tile, mask in _cross_tiles(descriptors, person_of)]
    impostor = np.concatenate(cosines) if cosines else np.empty(0, dtype=np.float32)
    if impostor.size == 0:
        raise ContractError(
            "photo consistency needs photos of at least two people: add people, or exclude fewer"
        )
    return impostor


def suspicious_pairs(
    descriptors: NDArray[np.float32],
    person_of: NDArray[np.int64],
    people: Sequence[str],
    *,
    above: float,
) -> list[SuspiciousPair]:
    """Pairs of people with two photos of raw cosine ``above`` or more, most alike first."""
    best: dict[tuple[int, int], float] = {}
    for start, tile, mask in _cross_tiles(descriptors, person_of):
        rows, columns = np.nonzero(mask & (tile >= np.float32(above)))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            a, b = int(person_of[start + row]), int(person_of[start + column])
            key = (min(a, b), max(a, b))
            best[key] = max(best.get(key, -1.0), float(tile[row, column]))
    ranked = sorted(best.items(), key=lambda entry: -entry[1])[:MOST_PAIRS]
    return [SuspiciousPair(people[a], people[b], round(cosine, 3)) for (a, b), cosine in ranked]


def _cross_tiles(
    descriptors: NDArray[np.float32], person_of: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.bool_]]]:
    """Yield (start, cosines, mask) of the upper triangle; columns begin at ``start`` as rows do."""
    count = len(descriptors)
    for start in range(0, count, TILE):
        stop = min(start + TILE, count)
        tile = descriptors[start:stop] @ descriptors[start:].T
        later = np.arange(start, count)[None, :] > np.arange(start, stop)[:, None]
        yield start, tile, later & (person_of[start:stop, None] != person_of[None, start:])
