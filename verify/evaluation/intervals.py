"""How far FNMR at FMR could have come out otherwise: replicates that resample people or pairs.

Pairs of one benchmark share people, so the people are resampled: one drawn w times weighs w in
its genuine pairs, and a pair of two people weighs the product of their weights (bootstrap by
subject, ISO/IEC 19795-1). Where a set names nobody, pairs are resampled. A replicate sets its own
threshold, so the spread of the threshold is in the interval too. All runs of a set see the same
draws, so that their mean can be taken replicate by replicate.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from verify.evaluation.comparison import Trials

REPLICATES = 400
GRID_POINTS = 49

Array64 = NDArray[np.float64]


def replicate_weights(
    trials: Trials, *, seed: int, replicates: int = REPLICATES
) -> Iterator[tuple[Array64, Array64]]:
    """Draw people with replacement; pairs, where the set does not name people.

    Yields the weights of the genuine (G,) and the impostor pairs (I,), one replicate at a time. One
    without any of either is drawn anew.
    """
    same, people = trials.same, trials.people
    generator = np.random.default_rng(seed)
    if people is not None:
        present, places = np.unique(people, return_inverse=True)
        one, two = places.reshape(2, -1)
        count = len(present)
    else:
        count = len(same)
    for _ in range(replicates):
        while True:
            drawn = np.bincount(generator.integers(count, size=count), minlength=count)
            if people is not None:
                drawn = drawn[one] * np.where(one == two, 1, drawn[two])
            weights = drawn.astype(np.float64)
            if weights[same].any() and weights[~same].any():
                break
        yield weights[same], weights[~same]


def fmr_grid(impostor_pairs: int) -> Array64:
    """FMR values of curves: from the least that the pairs resolve (3 / trials) to 1."""
    return np.geomspace(min(1.0, 3 / impostor_pairs), 1.0, GRID_POINTS)


class OperatingPoints:
    """FNMR at FMR targets, for the trials as they are or weighted."""

    def __init__(self, genuine: Array64, impostor: Array64) -> None:
        self._genuine_order = np.argsort(genuine, kind="stable")
        self._impostor_order = np.argsort(-impostor, kind="stable")
        ranked = impostor[self._impostor_order]
        # To accept k impostor pairs and reject the next, cut halfway between the two.
        cuts = np.empty(ranked.size + 1)
        cuts[0] = np.nextafter(ranked[0], np.inf)
        cuts[1:-1] = (ranked[:-1] + ranked[1:]) / 2
        # Halfway between neighbours may round to the lower one, which would accept it.
        cuts[1:-1] = np.where(cuts[1:-1] > ranked[1:], cuts[1:-1], ranked[:-1])
        cuts[-1] = ranked[-1]
        # A cut inside a run of equal similarities cannot be made: take the one before the run.
        tied = np.concatenate([[False], ranked[1:] == ranked[:-1], [False]])
        self._possible = np.maximum.accumulate(np.where(tied, 0, np.arange(tied.size)))
        self._missed = np.searchsorted(genuine[self._genuine_order], cuts, side="left")

    def fnmr(
        self, fmrs: Array64, *, genuine: Array64 | None = None, impostor: Array64 | None = None
    ) -> Array64:
        """FNMR, (F,), at the lowest threshold whose FMR is at most each of ``fmrs``.

        The trials may have whole-numbered weights.
        """
        genuine_weights = np.ones(self._genuine_order.size) if genuine is None else genuine
        impostor_weights = np.ones(self._impostor_order.size) if impostor is None else impostor
        accepted = np.concatenate([[0.0], np.cumsum(impostor_weights[self._impostor_order])])
        # Sums of weights are exact; only the product with a target needs room for rounding.
        allowed = fmrs * accepted[-1] * (1 + 1e-12)
        k = np.searchsorted(accepted, allowed, side="right") - 1
        below = np.concatenate([[0.0], np.cumsum(genuine_weights[self._genuine_order])])
        return np.asarray(below[self._missed[self._possible[k]]] / below[-1])


def percentiles(replicates: NDArray[np.float32]) -> tuple[Array64, Array64]:
    """95 % interval of the mean over runs; (runs, R, F) to two (F,).

    In each replicate the runs are drawn with replacement too, so that the interval holds what
    comes from the choice of decoys as well as what comes from the choice of people.
    """
    runs, count, _ = replicates.shape
    drawn = np.random.default_rng(runs).integers(runs, size=(runs, count))
    means = replicates[drawn, np.arange(count)].mean(axis=0, dtype=np.float64)
    low, high = np.percentile(means, [2.5, 97.5], axis=0)
    return low, high
