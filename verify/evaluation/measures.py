"""What one run of a cell shows: accuracy by ten folds, and error rates, with raw counts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verify.evaluation.units import Search
from verify.metrics import equal_error_rate, resolvable, threshold_at_fmr
from verify.tenfold import TenFold, best_grid_threshold, best_threshold, ten_fold

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorsAt:
    """Counts at the threshold of one FMR target.

    Parameters
    ----------
    target
        FMR that the threshold must not exceed.
    threshold
        Similarity.
    errors, trials
        Genuine pairs below it, of how many.
    fmr_errors, fmr_trials
        Impostor pairs at or above it, of how many.
    """

    target: float
    threshold: float
    errors: int
    trials: int
    fmr_errors: int
    fmr_trials: int


@dataclass(frozen=True)
class Measures:
    """All figures of one run.

    Parameters
    ----------
    ten_fold
        Accuracies and thresholds of the folds.
    eer, auc, d_prime
        Equal error rate; area under the ROC; (μ_g − μ_i) / √((σ_g² + σ_i²) / 2) of similarities.
    at
        One entry for each target that the impostor pairs resolve.
    collisions
        Impostor pairs at a distance below ``COLLISION``.
    """

    ten_fold: TenFold
    eer: float
    auc: float
    d_prime: float
    at: tuple[ErrorsAt, ...]
    collisions: int


COLLISION = 1e-3
"""Two subspaces nearer than this share a decoy: distinct faces are never that close."""


def measure(
    similarities: Floats,
    same: NDArray[np.bool_],
    folds: NDArray[np.int64],
    *,
    targets: Sequence[float],
    search: Search = "exact",
) -> Measures:
    """Measure one run.

    Parameters
    ----------
    similarities, same, folds : (P,)
        Of every pair.
    targets
        FMR targets; those that the impostor pairs cannot resolve are left out.
    search
        ``grid`` is the literature's, for raw descriptors.
    """
    mated, non_mated = similarities[same], similarities[~same]
    return Measures(
        ten_fold=ten_fold(
            similarities,
            same,
            folds,
            search=best_threshold if search == "exact" else best_grid_threshold,
        ),
        eer=equal_error_rate(mated, non_mated)[0],
        auc=area_under_roc(mated, non_mated),
        d_prime=d_prime(mated, non_mated),
        at=tuple(
            errors_at(mated, non_mated, target)
            for target in targets
            if resolvable(target, non_mated.size)
        ),
        collisions=int(np.count_nonzero(2 - 2 * non_mated < COLLISION**2)),
    )


def errors_at(mated: Floats, non_mated: Floats, target: float) -> ErrorsAt:
    """Count both errors at the lowest threshold whose FMR is at most the target."""
    threshold = threshold_at_fmr(non_mated, target)
    return ErrorsAt(
        target=target,
        threshold=threshold,
        errors=int(np.count_nonzero(mated < threshold)),
        trials=mated.size,
        fmr_errors=int(np.count_nonzero(non_mated >= threshold)),
        fmr_trials=non_mated.size,
    )


def area_under_roc(mated: Floats, non_mated: Floats) -> float:
    """Probability that a genuine pair is more alike than an impostor pair; ties count half."""
    # Imported here, because it takes a second to load, and most commands need none.
    from scipy.stats import rankdata

    ranks = rankdata(np.concatenate([mated, non_mated]))
    wins = ranks[: mated.size].sum() - mated.size * (mated.size + 1) / 2
    return float(wins / (mated.size * non_mated.size))


def d_prime(mated: Floats, non_mated: Floats) -> float:
    """Separation of the two distributions in pooled standard deviations; 0 where both are one."""
    spread = np.sqrt((mated.var() + non_mated.var()) / 2)
    gap = float(mated.mean() - non_mated.mean())
    if spread > 0:
        return float(gap / spread)
    return float(np.copysign(np.inf, gap)) if gap else 0.0
