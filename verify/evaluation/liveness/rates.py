"""Liveness thresholds for a stated BPCER (ISO/IEC 30107-3)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from templates.contract.liveness import LivenessCalibration
from verify.datasets import DatasetError
from verify.evaluation.liveness.scores import ScoredSet
from verify.metrics import RULE_OF_THREE, resolvable, threshold_at_fmr


def threshold_at_bpcer(live: ArrayLike, target: float) -> float:
    """Highest threshold whose BPCER on these live scores is at most the target.

    It lies halfway between the last score that is rejected and the first that passes.
    """
    scores = np.asarray(live, dtype=np.float64)
    if not resolvable(target, scores.size):
        raise DatasetError(
            f"{scores.size} live photos cannot resolve BPCER {target:g}: it takes"
            f" {RULE_OF_THREE / target:.0f}; add photos, or state a higher rate"
        )
    # The same search from the other end: scores count as errors where they are too low.
    return -threshold_at_fmr(-scores, target)


def calibrate_liveness(
    scored: ScoredSet, graphs: Sequence[str], *, target: float
) -> LivenessCalibration:
    """Set the threshold at a stated BPCER, and count both errors there."""
    threshold = threshold_at_bpcer(scored.scored(None), target)
    return LivenessCalibration(
        graphs=tuple(graphs),
        threshold=threshold,
        bpcer=scored.bpcer(threshold),
        target_bpcer=target,
        apcer={
            name: scored.apcer(name, threshold)
            for name in scored.presented.species
            if len(scored.scored(name))
        },
        calibrated_on={
            "dataset": scored.presented.name,
            "subjects": scored.presented.subjects,
            "live_without_face": scored.non_response(None).errors,
            "attacks_without_face": {
                name: scored.non_response(name).errors for name in scored.presented.species
            },
        },
    )
