"""Both thresholds of a level, at the same marginal quantile (docs/method.md §6.2).

Setting each test alone at the target FMR would halve the joint FMR and waste genuine users. So
both thresholds are set at one marginal quantile q, and q is the largest at which the *joint* FMR
on the impostor trials is at most the target.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.contract.document import Level, Rate
from templates.errors import ContractError
from verify.metrics import between, most_errors, resolvable, subject_bootstrap

TARGETS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)

EXPECTED_ERRORS = 10.0
"""False matches that a level must expect on its impostor trials. Stricter than the rule of three
(3 / N), which suits a rate that is only read: a threshold is *set* on these trials, and with k of
them beyond it the relative standard error of the true rate is about 1/√k, a third for 10."""

Scores = NDArray[np.float32]
Array64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Impostors:
    """Impostor trials of one calibration.

    Parameters
    ----------
    similarities, cohort_scores : (R,) float32
        Minus infinity marks a cell that is no trial (a probe against its own person).
    trials
        Number of cells that are trials.
    people
        Number of people.
    person_pairs
        Number of distinct unordered pairs of people among the trials.
    people_of
        Maps (E,) positions in the arrays to the (E, 2) people of those trials.
    weighted_trials
        Total weight of all trials under (people,) bootstrap weights.
    """

    similarities: Scores
    cohort_scores: Scores
    trials: int
    people: int
    person_pairs: int
    people_of: Callable[[NDArray[np.int64]], NDArray[np.int64]]
    weighted_trials: Callable[[Array64], float]


@dataclass(frozen=True, eq=False, repr=False)
class Genuine:
    """Genuine trials: (G,) similarities, cohort scores and people."""

    similarities: Scores
    cohort_scores: Scores
    people: NDArray[np.int64]


def resolved_targets(
    impostors: Impostors, targets: Sequence[float] = TARGETS
) -> tuple[list[float], list[str]]:
    """Split targets into those the trials resolve and sentences about those they do not.

    A target needs ``EXPECTED_ERRORS`` expected false matches among the trials, and by the rule of
    three no fewer than 3 / target distinct pairs of people, since trials of one pair of people
    repeat each other.
    """
    kept, refused = [], []
    for target in sorted(targets, reverse=True):
        enough = resolvable(target, impostors.trials, expected_errors=EXPECTED_ERRORS)
        if enough and resolvable(target, impostors.person_pairs):
            kept.append(target)
        else:
            refused.append(
                f"FMR {target:g} is not resolved by {impostors.trials} impostor trials of "
                f"{impostors.person_pairs} pairs of people: it needs "
                f"{EXPECTED_ERRORS / target:.0f} trials and {3 / target:.0f} pairs"
            )
    return kept, refused


class JointTails:
    """Upper tails of both impostor scores; finds joint thresholds, for falling targets cheaply."""

    def __init__(self, impostors: Impostors) -> None:
        self._trials = impostors.trials
        self._sorted = tuple(
            np.sort(scores) for scores in (impostors.similarities, impostors.cohort_scores)
        )
        self._tail = (impostors.similarities, impostors.cohort_scores)

    def at_rank(self, rank: int) -> tuple[float, float]:
        """Thresholds that accept the ``rank`` highest scores of either test, ties aside."""
        if not 0 <= rank <= self._trials:
            raise ValueError("a rank lies in 0 … the number of trials")
        return self._marginal(0, rank), self._marginal(1, rank)

    def for_target(self, target: float) -> tuple[float, float]:
        """Thresholds at the largest common rank whose joint FMR is at most the target."""
        allowed = most_errors(target, self._trials)
        # At a rank k at most k trials pass both, so the search starts at the allowed count.
        low, high = allowed, max(1, 2 * allowed)
        while high < self._trials and self._joint(high) <= allowed:
            low, high = high, min(self._trials, 2 * high)
        if high >= self._trials and self._joint(self._trials) <= allowed:
            return self.at_rank(self._trials)
        self._shrink(high)
        while high - low > 1:
            middle = (low + high) // 2
            if self._joint(middle) <= allowed:
                low = middle
            else:
                high = middle
        return self.at_rank(low)

    def rank_of(self, similarity: float) -> int:
        """Number of impostor trials at or above a similarity."""
        scores = self._sorted[0]
        return int(scores.size - np.searchsorted(scores, np.float64(similarity), side="left"))

    def _marginal(self, test: int, rank: int) -> float:
        scores = self._sorted[test]
        position = scores.size - rank
        if rank == 0:
            return float(np.nextafter(np.float64(scores[-1]), np.inf))
        accepted = np.float64(scores[position])
        if rank == self._trials:
            return float(accepted)
        rejected = np.float64(scores[position - 1])
        if rejected < accepted:
            return between(float(rejected), float(accepted))
        # A tie across the border: reject all of it, so that no rank accepts more than it says.
        above = np.searchsorted(scores, accepted, side="right")
        if above == scores.size:
            return float(np.nextafter(accepted, np.inf))
        return between(float(accepted), float(scores[above]))

    def _joint(self, rank: int) -> int:
        similarity, cohort = self.at_rank(rank)
        return int(np.count_nonzero(_passes(*self._tail, similarity, cohort)))

    def _shrink(self, rank: int) -> None:
        """Forget trials that no later, stricter threshold can accept."""
        similarity, cohort = self.at_rank(rank)
        kept = _passes(*self._tail, similarity, cohort)
        self._tail = (self._tail[0][kept], self._tail[1][kept])


def _passes(
    similarities: Scores, cohort_scores: Scores, similarity: float, cohort: float
) -> NDArray[np.bool_]:
    # A NumPy float64 keeps the comparison in float64, where a Python float would not.
    return np.asarray(
        (similarities >= np.float64(similarity)) & (cohort_scores >= np.float64(cohort))
    )


def make_level(
    name: str,
    target: float | None,
    thresholds: tuple[float, float],
    impostors: Impostors,
    genuine: Genuine,
    *,
    seed: int,
) -> Level:
    """Count both errors at given thresholds, with subject-bootstrap intervals."""
    matched = np.flatnonzero(_passes(impostors.similarities, impostors.cohort_scores, *thresholds))
    missed = genuine.people[
        ~_passes(genuine.similarities, genuine.cohort_scores, *thresholds)
    ].reshape(-1)
    counts = np.bincount(genuine.people, minlength=impostors.people).astype(np.float64)
    fmr: Rate = subject_bootstrap(
        impostors.people_of(matched),
        people=impostors.people,
        trials=impostors.trials,
        weighted_trials=impostors.weighted_trials,
        seed=seed,
    )
    fnmr: Rate = subject_bootstrap(
        np.stack([missed, missed], axis=1),
        people=impostors.people,
        trials=len(genuine.people),
        weighted_trials=lambda weights: float(counts @ weights),
        seed=seed + 1,
    )
    return Level(
        name=name,
        target_fmr=target,
        similarity_threshold=thresholds[0],
        cohort_threshold=thresholds[1],
        fmr=fmr,
        fnmr=fnmr,
    )


def level_name(target: float) -> str:
    """Name of the level of a target: ``fmr-1e-3``.

    Raises
    ------
    ContractError
        Where the target is no power of ten below 1: two targets must not share a name.
    """
    if 0 < target < 1:
        exponent = round(-math.log10(target))
        if exponent and math.isclose(target, 10.0**-exponent, rel_tol=1e-9):
            return f"fmr-1e-{exponent}"
    raise ContractError(
        f"{target:g} is not an FMR target: use powers of ten below 1, such as 0.001"
    )
