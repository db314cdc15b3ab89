"""What a reader should know about a set that is no error, in sentences."""

import numpy as np

from verify.evaluation.verification_set import VerificationSet
from verify.tenfold import FOLDS

PUBLISHED = {
    "lfw": 6000,
    "agedb_30": 6000,
    "calfw": 6000,
    "cplfw": 6000,
    "cfp_ff": 7000,
    "cfp_fp": 7000,
}
"""Pairs of the published sets, by name."""


def notes(benchmark: VerificationSet) -> list[str]:
    """Say where a set differs from the published one, and what in it is unusual."""
    name, pairs = benchmark.name, len(benchmark)
    sentences = []
    published = PUBLISHED.get(name)
    if published is not None and pairs != published:
        sentences.append(f"{name} has {pairs:,} pairs, the published set has {published:,}")
    if benchmark.folds is not None:
        sizes = np.bincount(benchmark.folds, minlength=FOLDS)
        genuine = np.bincount(benchmark.folds[benchmark.same], minlength=FOLDS)
    if benchmark.folds is not None and (np.ptp(sizes) or np.ptp(genuine)):
        sentences.append(
            f"{name}: folds differ in their numbers of genuine or impostor pairs "
            f"({sizes.min():,} to {sizes.max():,} pairs a fold)"
        )
    if own := int(np.count_nonzero(benchmark.first == benchmark.second)):
        sentences.append(f"{name}: {_pairs(own)} a photo with itself")
    unordered = np.sort(np.stack([benchmark.first, benchmark.second], axis=1), axis=1)
    if twice := pairs - len(np.unique(unordered, axis=0)):
        sentences.append(f"{name}: {_pairs(twice)} the same two photos as another pair")
    if benchmark.people is not None:
        people = np.unique(np.array(benchmark.people), return_inverse=True)[1]
        agree = (people[benchmark.first] == people[benchmark.second]) == benchmark.same
        if wrong := int(np.count_nonzero(~agree)):
            sentences.append(f"{name}: {_pairs(wrong)} people whose names contradict the label")
    return sentences


def _pairs(count: int) -> str:
    return f"{count:,} pair compares" if count == 1 else f"{count:,} pairs compare"
