"""Error rates on similarities, with counts and intervals (terms of ISO/IEC 19795-1).

A comparison is a match where its similarity is at or above the threshold. All thresholds and
comparisons are float64: a Python float against a float32 array would be rounded first, and the
rounding can move a score across its own threshold.
"""

import math
from collections.abc import Callable
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.contract.document import Rate

Array64 = NDArray[np.float64]

RULE_OF_THREE = 3.0
"""With no error in N independent trials, the 95 % upper bound of the rate is 3 / N."""


def wilson(errors: float, trials: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a proportion; (0, 1) where there are no trials.

    References
    ----------
    E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    JASA 22 (1927).
    """
    if trials == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p = errors / trials
    centre = p + z * z / (2 * trials)
    spread = z * math.sqrt(p * (1 - p) / trials + (z / (2 * trials)) ** 2)
    scale = 1 + z * z / trials
    # At 0 and at all errors the bound is exactly the rate; rounding must not cross it.
    low = 0.0 if errors == 0 else max(0.0, (centre - spread) / scale)
    high = 1.0 if errors == trials else min(1.0, (centre + spread) / scale)
    return low, high


def rate(errors: int, trials: int) -> Rate:
    """Rate with its Wilson interval, for trials that are independent."""
    low, high = wilson(errors, trials)
    return Rate(errors=errors, trials=trials, ci_low=low, ci_high=high)


def most_errors(target: float, trials: int) -> int:
    """Largest count whose rate is at most the target, free of rounding in ``target * trials``."""
    count = math.floor(target * trials)
    while (count + 1) / trials <= target:
        count += 1
    while count > 0 and count / trials > target:
        count -= 1
    return count


def threshold_at_fmr(impostor: ArrayLike, target: float, *, trials: int | None = None) -> float:
    """Lowest threshold whose FMR on these impostors is at most the target, never the nearest.

    The threshold lies halfway between the last similarity that it accepts and the first that it
    rejects; above all of them where the target allows no error. ``trials`` counts them where
    ``impostor`` holds only the highest similarities, more of them than the target allows errors,
    or cells that are no trials and hold minus infinity.
    """
    scores = np.asarray(impostor).ravel()
    if scores.size == 0 or not 0.0 <= target <= 1.0:
        raise ValueError("a threshold needs impostor trials and a target in [0, 1]")
    total = scores.size if trials is None else trials
    allowed = most_errors(target, total)
    # Only the upper tail decides; sorting millions of scores in float64 would triple the memory.
    if allowed + 2 < scores.size:
        scores = np.partition(scores, scores.size - allowed - 2)[-allowed - 2 :]
    scores = np.sort(scores.astype(np.float64))[::-1]
    if allowed == total:
        return float(scores[-1])
    if allowed >= scores.size:
        raise ValueError("the highest similarities must outnumber the errors that are allowed")
    first_rejected = scores[allowed]
    above = scores[scores > first_rejected]
    if above.size == 0:
        return float(np.nextafter(first_rejected, np.inf))
    middle = float(first_rejected) + (float(above[-1]) - float(first_rejected)) / 2
    return middle if middle > first_rejected else float(above[-1])


def resolvable(target: float, trials: int, *, expected_errors: float = RULE_OF_THREE) -> bool:
    """Whether ``trials`` can speak about a rate of ``target``: at least 3 errors expected.

    Ask for more expected errors where a threshold is *set* on the data: at k errors the relative
    standard error of the rate beyond the threshold is about 1/√k.
    """
    # The tolerance keeps 3,000 trials able to resolve 1e-3, as 1e-3 * 3000 rounds below 3.
    return target * trials >= expected_errors * (1 - 1e-9)


def equal_error_rate(genuine: ArrayLike, impostor: ArrayLike) -> float:
    """EER: the mean of FMR and FNMR at the threshold where they are nearest to each other."""
    own = np.sort(np.asarray(genuine, dtype=np.float64).ravel())
    others = np.sort(np.asarray(impostor, dtype=np.float64).ravel())
    observed = np.unique(np.concatenate([own, others]))
    thresholds = np.append(observed, np.nextafter(observed[-1], np.inf))
    fmr = 1.0 - np.searchsorted(others, thresholds, side="left") / others.size
    fnmr = np.searchsorted(own, thresholds, side="left") / own.size
    nearest = int(np.argmin(np.abs(fmr - fnmr)))
    return float(fmr[nearest] + fnmr[nearest]) / 2


def subject_bootstrap(
    errors: NDArray[np.integer],
    *,
    people: int,
    trials: int,
    weighted_trials: Callable[[Array64], float],
    replicates: int = 1000,
    seed: int = 0,
) -> Rate:
    """Rate with an interval that resamples people, since trials share them.

    A replicate draws ``people`` people with replacement; a person drawn w times weighs w. A trial
    between people a ≠ b weighs w_a w_b, a trial within one person w_a. ``errors`` has the two
    people of every trial that went wrong, (E, 2). The percentile interval of the replicates is
    widened to the Wilson interval where it is narrower: with few errors, or none, resampling what
    was seen knows nothing of what was not.
    """
    count = len(errors)
    low, high = wilson(count, trials)
    if count:
        keys, repeats = np.unique(
            errors[:, 0].astype(np.int64) * people + errors[:, 1], return_counts=True
        )
        first, second = np.divmod(keys, people)
        within = first == second
        generator = np.random.default_rng(seed)
        rates = []
        for _ in range(replicates):
            drawn = generator.integers(people, size=people)
            weights = np.bincount(drawn, minlength=people).astype(np.float64)
            total = weighted_trials(weights)
            if total > 0:
                each = weights[first] * np.where(within, 1.0, weights[second])
                rates.append(float(repeats @ each) / total)
        if rates:
            lower, upper = np.percentile(np.clip(rates, 0.0, 1.0), [2.5, 97.5])
            low, high = min(low, float(lower)), max(high, float(upper))
    return Rate(errors=count, trials=trials, ci_low=low, ci_high=high, interval="subject-bootstrap")
