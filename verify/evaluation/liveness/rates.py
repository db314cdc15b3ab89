"""Error rates of presentation attack detection, and thresholds for a stated BPCER.

Terms of ISO/IEC 30107-3. A presentation is taken for live where its score is at or above the
threshold. APCER is of one attack species at a time, and the worst is the headline: an attacker
chooses. Photos in which no face was found have no score; they are counted apart, as non-responses.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from templates.contract.levels import Rate
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


def bpcer(scored: ScoredSet, threshold: float) -> Rate:
    """Share of the live photos with a face that are taken for attacks."""
    return scored.rate(None, scored.scores < threshold, among=scored.acquired)


def apcer(scored: ScoredSet, species: str, threshold: float) -> Rate:
    """Share of the attack photos of one species with a face that are taken for live."""
    return scored.rate(species, scored.scores >= threshold, among=scored.acquired)


def non_response(scored: ScoredSet, species: str | None) -> Rate:
    """Share of the photos of one species (APNRR), or of the live ones (BPNRR), without a face."""
    return scored.rate(species, ~scored.acquired, among=np.ones_like(scored.acquired))


def calibrate_liveness(
    scored: ScoredSet, graphs: Sequence[str], *, target: float
) -> LivenessCalibration:
    """Set the threshold at a stated BPCER, and count both errors there."""
    threshold = threshold_at_bpcer(scored.scored(None), target)
    return LivenessCalibration(
        graphs=tuple(graphs),
        threshold=threshold,
        bpcer=bpcer(scored, threshold),
        target_bpcer=target,
        apcer={
            name: apcer(scored, name, threshold)
            for name in scored.presented.species
            if len(scored.scored(name))
        },
        calibrated_on=_counts(scored),
    )


def _counts(scored: ScoredSet) -> dict[str, Any]:
    return {
        "dataset": scored.presented.name,
        "subjects": scored.presented.subjects,
        "live_without_face": non_response(scored, None).errors,
        "attacks_without_face": {
            name: non_response(scored, name).errors for name in scored.presented.species
        },
    }
