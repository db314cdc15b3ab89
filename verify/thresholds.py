"""The threshold of a level, for a stated false match rate on impostor trials."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from templates.contract.document import Level, Rate
from templates.errors import ContractError
from verify.metrics import most_errors, resolvable, subject_bootstrap

TARGETS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)

EXPECTED_ERRORS = 10.0
"""False matches that a level must expect on its impostor trials. Stricter than the rule of three
(3 / N), which suits a rate that is only read: a threshold is *set* on these trials, and with k of
them beyond it the relative standard error of the true rate is about 1/√k, a third for 10."""

MOST_OVER = 2.0
"""Largest 95 % bound of a level's FMR, in multiples of its target."""
RESAMPLES = 200

Scores = NDArray[np.float32]
Array64 = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class Impostors:
    """Impostor trials of one calibration: each probe meets the templates of W people.

    Probes are in groups of one size, but for the last; all of a group meet the same people.
    """

    cells: Scores  # (R, W); minus infinity where a probe meets its own person, which is no trial
    owners: Indices  # (R,) people of the probes
    met: Indices  # (groups, W) people whose templates they meet
    size: int  # of a group
    people: int

    @property
    def scores(self) -> Scores:
        """All cells in one row, (R W,)."""
        return self.cells.reshape(-1)

    @cached_property
    def trials(self) -> int:
        """Number of the cells that are trials."""
        return int(np.count_nonzero(np.isfinite(self.cells)))

    def people_of(self, places: Indices) -> Indices:
        """Give the two people of cells, (E,) to (E, 2)."""
        row, column = np.divmod(places, self.cells.shape[1])
        return np.stack([self.owners[row], self.met[row // self.size, column]], axis=1)

    @cached_property
    def _by_group(self) -> tuple[Array64, Array64, Array64]:
        """Probes of each person in each group, whether it meets them, and probes that meet both."""
        group = np.arange(len(self.owners)) // self.size
        probes, meets = np.zeros((2, len(self.met), self.people))
        np.add.at(probes, (group, self.owners), 1)
        meets[np.arange(len(self.met))[:, None], self.met] = 1
        return probes, meets, (probes * meets).sum(axis=0)

    def weighted_trials(self, weights: Array64) -> float:
        """Weight of all trials under bootstrap weights of the people, (people,)."""
        probes, meets, own_cells = self._by_group
        return float((probes @ weights) @ (meets @ weights) - own_cells @ weights**2)

    @cached_property
    def person_pairs(self) -> int:
        """Number of distinct pairs of people, in either order."""
        compared, place = np.unique(self.met, return_inverse=True)
        pairs = np.zeros((self.people, len(compared)), dtype=np.bool_)
        for probes, columns in zip(self._by_group[0], place.reshape(self.met.shape), strict=True):
            pairs[np.ix_(np.flatnonzero(probes), columns)] = True
        pairs[compared, np.arange(len(compared))] = False
        square = pairs[compared]
        return int(np.count_nonzero(pairs) - np.count_nonzero(np.triu(square & square.T)))


@dataclass(frozen=True, eq=False, repr=False)
class Genuine:
    """Genuine trials."""

    scores: Scores  # (G,), as all others
    people: NDArray[np.int64]
    enrolled_photos: NDArray[np.int64]  # that made each one's template
    refused: NDArray[np.bool_]  # photos that do not agree: the service does not compare them


def resolved_targets(
    impostors: Impostors, targets: Sequence[float] = TARGETS
) -> tuple[list[float], list[str]]:
    """Split targets into those the trials resolve and sentences about those they do not.

    A target needs ``EXPECTED_ERRORS`` expected false matches among the trials, and by the rule of
    three no fewer than 3 / target distinct pairs of people, since trials of one pair of people
    repeat each other. Of these, the 95 % bound of its FMR (:func:`bound_when_set_anew`) must be at
    most ``MOST_OVER`` times the target.
    """
    kept, refused = [], []
    for target in sorted(targets, reverse=True):
        enough = resolvable(target, impostors.trials, expected_errors=EXPECTED_ERRORS)
        if not enough or not resolvable(target, impostors.person_pairs):
            refused.append(
                f"FMR {target:g} is not resolved by {impostors.trials} impostor trials of "
                f"{impostors.person_pairs} pairs of people: it needs "
                f"{EXPECTED_ERRORS / target:.0f} trials and {3 / target:.0f} pairs"
            )
        elif (bound := bound_when_set_anew(impostors, target)) > MOST_OVER * target:
            refused.append(
                f"FMR {target:g} is not resolved by {impostors.people} people: a threshold set on "
                f"others like them may let {bound:.3g} pass, and {MOST_OVER * target:g} is the most"
            )
        else:
            kept.append(target)
    return kept, refused


def bound_when_set_anew(impostors: Impostors, target: float) -> float:
    """95 % bound of the FMR on these trials of a threshold that is set on people like these.

    Every resample draws people with replacement and sets the threshold on their trials; the FMR of
    all trials at that threshold is what others would see.
    """
    count = min(len(impostors.scores), 4 * most_errors(target, impostors.trials) + 1_000)
    highest = np.argpartition(impostors.scores, len(impostors.scores) - count)[-count:]
    highest = highest[np.isfinite(impostors.scores[highest])]
    highest = highest[np.argsort(-impostors.scores[highest], kind="stable")]
    first, second = impostors.people_of(highest).T
    rng = np.random.default_rng(0)
    rates = np.empty(RESAMPLES)
    for number in range(RESAMPLES):
        drawn = rng.integers(impostors.people, size=impostors.people)
        weights = np.bincount(drawn, minlength=impostors.people).astype(np.float64)
        allowed = target * impostors.weighted_trials(weights)
        passed = np.cumsum(weights[first] * weights[second])
        rates[number] = np.searchsorted(passed, allowed, side="right") / impostors.trials
    return float(np.quantile(rates, 0.95))


def make_level(
    name: str,
    target: float | None,
    threshold: float,
    impostors: Impostors,
    genuine: Genuine,
    *,
    seed: int,
) -> Level:
    """Count both errors at a given threshold, with subject-bootstrap intervals."""
    # A NumPy float64 keeps the comparison in float64, where a Python float would not.
    bound = np.float64(threshold)
    matched = np.flatnonzero(impostors.scores >= bound)
    missed = ~(genuine.scores >= bound)
    compared = ~genuine.refused
    fmr: Rate = subject_bootstrap(
        impostors.people_of(matched),
        people=impostors.people,
        trials=impostors.trials,
        weighted_trials=impostors.weighted_trials,
        seed=seed,
    )

    def wrongly_rejected(tried: NDArray[np.bool_]) -> Rate:
        counts = np.bincount(genuine.people[tried], minlength=impostors.people)
        wrong = genuine.people[tried & (missed | genuine.refused)]
        return subject_bootstrap(
            np.stack([wrong, wrong], axis=1),
            people=impostors.people,
            trials=int(np.count_nonzero(tried)),
            weighted_trials=lambda weights: float(counts @ weights),
            seed=seed + 1,
        )

    return Level(
        name=name,
        target_fmr=target,
        threshold=threshold,
        fmr=fmr,
        fnmr=wrongly_rejected(compared),
        fnmr_by_photos={
            int(photos): wrongly_rejected(compared & (genuine.enrolled_photos == photos))
            for photos in np.unique(genuine.enrolled_photos[compared])
        },
        frr_by_photos={
            int(photos): wrongly_rejected(genuine.enrolled_photos == photos)
            for photos in np.unique(genuine.enrolled_photos)
            if genuine.refused.any()
        },
    )


def level_name(target: float) -> str:
    """Name of the level of a target: ``fmr-1e-3``."""
    if 0 < target < 1:
        exponent = round(-math.log10(target))
        if exponent and math.isclose(target, 10.0**-exponent, rel_tol=1e-9):
            return f"fmr-1e-{exponent}"
    raise ContractError(
        f"{target:g} is not an FMR target: use powers of ten below 1, such as 0.001"
    )
