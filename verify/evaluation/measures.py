"""What one run shows: accuracy by ten folds and error rates, with raw counts, as plain values."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from verify.evaluation.plan import Json
from verify.metrics import equal_error_rate, resolvable, threshold_at_fmr
from verify.tenfold import best_grid_threshold, best_threshold, ten_fold

Array64 = NDArray[np.float64]


def measure(
    similarities: Array64,
    same: NDArray[np.bool_],
    folds: NDArray[np.int64] | None,
    *,
    targets: Sequence[float],
    search: str = "exact",
) -> Json:
    """Measure one run.

    Returns
    -------
    accuracies, thresholds
        Of the ten folds; None without folds.
    eer, auc
        Equal error rate; area under the ROC.
    fnmr_at_fmr
        By target: the lowest threshold whose FMR is at most the target, ``errors`` of ``trials``
        genuine pairs below it, ``fmr_errors`` of ``fmr_trials`` impostor pairs at or above it.
    """
    genuine, impostor = similarities[same], similarities[~same]
    tenth = None
    if folds is not None:
        searches = {"exact": best_threshold, "grid": best_grid_threshold}
        tenth = ten_fold(similarities, same, folds, search=searches[search])
    return {
        "threshold_search": search,
        "accuracies": None if tenth is None else list(tenth.accuracies),
        "thresholds": None if tenth is None else list(tenth.thresholds),
        "eer": equal_error_rate(genuine, impostor),
        "auc": area_under_roc(genuine, impostor),
        "fnmr_at_fmr": {
            f"{target:g}": errors_at(genuine, impostor, target)
            for target in targets
            if resolvable(target, impostor.size)
        },
    }


def errors_at(genuine: Array64, impostor: Array64, target: float) -> Json:
    """Count both errors at the lowest threshold whose FMR is at most the target."""
    threshold = threshold_at_fmr(impostor, target)
    return {
        "threshold": threshold,
        "errors": int(np.count_nonzero(genuine < threshold)),
        "trials": genuine.size,
        "fmr_errors": int(np.count_nonzero(impostor >= threshold)),
        "fmr_trials": impostor.size,
    }


def area_under_roc(genuine: Array64, impostor: Array64) -> float:
    """Probability that a genuine pair is more alike than an impostor pair; ties count half."""
    ranked = np.sort(impostor)
    below, not_above = (np.searchsorted(ranked, genuine, side) for side in ("left", "right"))
    return float((below + not_above).sum() / (2 * genuine.size * impostor.size))
