"""What one run of a cell shows: accuracy by ten folds, and error rates, with raw counts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verify.evaluation.units import Search
from verify.metrics import equal_error_rate, resolvable, threshold_at_fmr
from verify.tenfold import TenFold, best_grid_threshold, best_threshold, ten_fold

Array64 = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorsAt:
    """Counts at the threshold of one FMR target.

    Parameters
    ----------
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
class VerificationMeasures:
    """All figures of one run.

    Parameters
    ----------
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
    similarities: Array64,
    same: NDArray[np.bool_],
    folds: NDArray[np.int64],
    *,
    targets: Sequence[float],
    search: Search = "exact",
) -> VerificationMeasures:
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
    genuine, impostor = similarities[same], similarities[~same]
    return VerificationMeasures(
        ten_fold=ten_fold(
            similarities,
            same,
            folds,
            search=best_threshold if search == "exact" else best_grid_threshold,
        ),
        eer=equal_error_rate(genuine, impostor)[0],
        auc=area_under_roc(genuine, impostor),
        d_prime=d_prime(genuine, impostor),
        at=tuple(
            errors_at(genuine, impostor, target)
            for target in targets
            if resolvable(target, impostor.size)
        ),
        collisions=int(np.count_nonzero(2 - 2 * impostor < COLLISION**2)),
    )


def errors_at(genuine: Array64, impostor: Array64, target: float) -> ErrorsAt:
    """Count both errors at the lowest threshold whose FMR is at most the target."""
    threshold = threshold_at_fmr(impostor, target)
    return ErrorsAt(
        target=target,
        threshold=threshold,
        errors=int(np.count_nonzero(genuine < threshold)),
        trials=genuine.size,
        fmr_errors=int(np.count_nonzero(impostor >= threshold)),
        fmr_trials=impostor.size,
    )


def area_under_roc(genuine: Array64, impostor: Array64) -> float:
    """Probability that a genuine pair is more alike than an impostor pair; ties count half."""
    # Imported here, because it takes a second to load, and most commands need none.
    from scipy.stats import rankdata

    ranks = rankdata(np.concatenate([genuine, impostor]))
    wins = ranks[: genuine.size].sum() - genuine.size * (genuine.size + 1) / 2
    return float(wins / (genuine.size * impostor.size))


def d_prime(genuine: Array64, impostor: Array64) -> float:
    """Separation of the two distributions in pooled standard deviations; 0 where both are one."""
    spread = np.sqrt((genuine.var() + impostor.var()) / 2)
    gap = float(genuine.mean() - impostor.mean())
    if spread > 0:
        return float(gap / spread)
    return float(np.copysign(np.inf, gap)) if gap else 0.0
