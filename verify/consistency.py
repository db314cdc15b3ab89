"""How alike photos of one person must be, from the people of the calibration.

Two people who enroll as one are both accepted later: their mean lies between them. An ordinary
pair of people cannot, but somebody who may choose finds a partner, and even one photo in a thousand
pairs of strangers is much for that. So the limit stands as far from strangers as photos of one
person allow.

A probe is compared once and then forgotten: nobody gains a lasting place by mixing two people in
it. So its photos need only agree as those of strangers do not, and fewer genuine ones are refused.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.contract.document import Rate
from templates.errors import ContractError
from templates.space.agreement import weakest_split
from verify.metrics import rate, threshold_at_fmr

LAXEST_FMR = 1e-3
STRICTEST_FMR = 1e-6
MOST_REFUSED = 0.02
"""Share of genuine sets of photos that the limit may refuse, beyond what ``LAXEST_FMR`` does."""
DRAWS = 10
"""Sets of photos that each person gives, so that 80 people place the limit steadily."""
LEAST_PEOPLE = 40
"""People who must have as many photos as the sets have; else smaller sets are taken."""
_TAIL = 10
TILE = 1024
MOST_PHOTOS = 8_000
"""Photos whose pairs are all compared; of more a random subset is, in 0.3 GiB of memory."""
MOST_PAIRS = 50
"""Suspicious pairs that are reported at most."""


@dataclass(frozen=True)
class Consistency:
    """The limit, and what it does on the photos it was set on."""

    threshold: float  # least agreement of the photos of one enrollment (`templates.space`)
    probe_threshold: float
    fmr: Rate  # pairs of photos of different people that reach it
    refused: Rate  # genuine sets of photos that do not


def photo_consistency(
    embeddings: NDArray[np.float32],
    person_of: NDArray[np.int64],
    *,
    photos: int,
    rng: np.random.Generator,
) -> Consistency:
    """Set the limits. Of an enrollment: as strict as genuine sets allow, between two raw FMRs.

    It is the raw cosine at FMR 1e-6, or the agreement that all but 2 % of the genuine sets of
    ``photos`` photos reach where that is less; but at least the raw cosine at FMR 1e-3, so that
    mislabelled photos cannot lower it further. That is also a probe's limit, and an enrollment's
    where nobody has two photos.

    Notes
    -----
    Few calibrations resolve an FMR of 1e-6. The cosine there is extrapolated: the excesses over
    the cosine at FMR 1e-3, or at the FMR that ten pairs exceed where that is larger, are taken
    as exponential. On 29.6 million pairs of LFW that gives 0.353 at 1e-5, where 0.347 is seen. Real
    tails are lighter, so the value errs to the strict side, and single pairs of one person under
    two names, which dominate what is seen there, do not move it.
    """
    impostor = impostor_cosines(embeddings, person_of, rng=rng)
    lax, strict = lax_and_strict(impostor)
    genuine = np.sort(_genuine_agreements(embeddings, person_of, photos=photos, rng=rng))
    threshold = lax
    if len(genuine):
        allowed = max(0, int(MOST_REFUSED * (len(genuine) + 1)) - 1)
        threshold = max(lax, min(strict, float(genuine[allowed])))
    return Consistency(
        threshold=threshold,
        probe_threshold=lax,
        fmr=rate(int(np.count_nonzero(impostor >= np.float64(threshold))), impostor.size),
        refused=rate(int(np.count_nonzero(genuine < threshold)), len(genuine)),
    )


def match_cosine(
    embeddings: NDArray[np.float32], identities: Sequence[str], *, seed: int = 0
) -> float:
    """Raw cosine at FMR 1e-3 of labelled unit embeddings, (N, n): a match without any template."""
    person_of = np.unique(np.asarray(identities), return_inverse=True)[1]
    impostor = impostor_cosines(embeddings, person_of, rng=np.random.default_rng(seed))
    return lax_and_strict(impostor)[0]


def lax_and_strict(
    impostor: NDArray[np.float32], strict_fmr: float = STRICTEST_FMR
) -> tuple[float, float]:
    """Find the raw cosines at FMR 1e-3, or at what ten pairs exceed, and at ``strict_fmr``.

    The second is extrapolated: the tail beyond the first is taken as exponential.
    """
    lax_fmr = min(0.5, max(LAXEST_FMR, _TAIL / impostor.size))
    lax = threshold_at_fmr(impostor, lax_fmr)
    excess = impostor[impostor >= np.float64(lax)].astype(np.float64) - lax
    mean_excess = float(excess.mean()) if excess.size else 0.0
    return lax, lax + mean_excess * float(np.log(lax_fmr / strict_fmr))


def _genuine_agreements(
    embeddings: NDArray[np.float32],
    person_of: NDArray[np.int64],
    *,
    photos: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    order = np.argsort(person_of, kind="stable")
    people = np.split(order, np.cumsum(np.bincount(person_of))[:-1])
    size = max(2, photos)
    while size > 2 and sum(len(own) >= size for own in people) < LEAST_PEOPLE:
        size -= 1
    return np.array(
        [
            weakest_split(embeddings[rng.permutation(own)[:size]]).agreement
            for own in people
            if len(own) >= size
            for _ in range(DRAWS)
        ]
    )


@dataclass(frozen=True)
class SuspiciousPair:
    """Two people whose photos are so alike that they may be one person under two names."""

    first: str
    second: str
    cosine: float


def impostor_cosines(
    embeddings: NDArray[np.float32], person_of: NDArray[np.int64], *, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Raw cosines of all pairs of photos of different people.

    Of more than ``MOST_PHOTOS`` photos a random subset of that many is compared.
    """
    if len(embeddings) > MOST_PHOTOS:
        kept = rng.choice(len(embeddings), MOST_PHOTOS, replace=False)
        embeddings, person_of = embeddings[kept], person_of[kept]
    tiles = [tile[mask] for _, tile, mask in _cross_tiles(embeddings, person_of)]
    impostor = np.concatenate([np.empty(0, dtype=np.float32), *tiles])
    if impostor.size == 0:
        raise ContractError(
            "photo consistency needs photos of at least two people: add people, or exclude fewer"
        )
    return impostor


def suspicious_pairs(
    embeddings: NDArray[np.float32],
    person_of: NDArray[np.int64],
    people: Sequence[str],
    *,
    above: float,
) -> list[SuspiciousPair]:
    """Pairs of people with two photos of raw cosine ``above`` or more, most alike first."""
    best: dict[tuple[int, int], float] = {}
    for start, tile, mask in _cross_tiles(embeddings, person_of):
        rows, columns = np.nonzero(mask & (tile >= np.float32(above)))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            a, b = int(person_of[start + row]), int(person_of[start + column])
            key = (min(a, b), max(a, b))
            best[key] = max(best.get(key, -1.0), float(tile[row, column]))
    ranked = sorted(best.items(), key=lambda entry: -entry[1])[:MOST_PAIRS]
    return [SuspiciousPair(people[a], people[b], round(cosine, 3)) for (a, b), cosine in ranked]


def _cross_tiles(
    embeddings: NDArray[np.float32], person_of: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.bool_]]]:
    """Yield (start, cosines, mask) of the upper triangle; columns begin at ``start`` as rows do."""
    count = len(embeddings)
    for start in range(0, count, TILE):
        stop = min(start + TILE, count)
        tile = embeddings[start:stop] @ embeddings[start:].T
        later = np.arange(start, count)[None, :] > np.arange(start, stop)[:, None]
        yield start, tile, later & (person_of[start:stop, None] != person_of[None, start:])
