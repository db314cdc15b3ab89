"""The decision of the service, on arrays."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from templates.contract.document import Calibration, Level
from templates.contract.nobody import Nobody
from templates.distances import paired_distances, pairwise_distances, similarity
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes, cohort_statistics, expected_similarity


class Scores(NamedTuple):
    """What decisions rest on; float64 of shape (P, T), or (P,) where paired."""

    similarities: NDArray[np.float64]
    scores: NDArray[np.float64]

    def at(self, level: Level) -> NDArray[np.bool_]:
        """Decide at a level."""
        return np.asarray(self.scores >= level.threshold)


def score(
    probes: Probes,
    templates: SubspaceBatch,
    nobody: Nobody,
    calibration: Calibration,
    *,
    paired: bool = False,
    cohort: SubspaceBatch | None = None,
) -> Scores:
    """Score as ``verify.Verifier`` does, for many probes and templates.

    What the service refuses before it decides, such as a probe that is not of unit length, is not
    refused here. Neither probes nor templates are rotated: a rotation of both changes nothing.

    Parameters
    ----------
    probes : (P, k) float32, or SubspaceBatch of P
    templates : SubspaceBatch of T
    paired
        Probe i meets template i only.
    nobody
        Of the contract.
    cohort
        Instead of the contract's, which is secret, for lifted probes: an attacker tries with one of
        their own.
    """
    compare = paired_distances if paired else pairwise_distances
    distances = compare(probes, templates, metric=calibration.metric, steps=calibration.steps)
    similarities = np.asarray(similarity(distances), dtype=np.float64)
    if cohort is not None and isinstance(probes, SubspaceBatch):
        means, spreads = cohort_statistics(
            probes, cohort, metric=calibration.metric, steps=calibration.steps
        )
    else:
        means, spreads = expected_similarity(
            probes, nobody, metric=calibration.metric, steps=calibration.steps
        )
    if not paired:
        means, spreads = means[:, None], spreads[:, None]
    return Scores(similarities, (similarities - means) / spreads)


def fmr_of(level: Level) -> float:
    """Return what a stranger reaches at a level: its FMR."""
    return level.fmr.value if level.target_fmr is None else level.target_fmr
