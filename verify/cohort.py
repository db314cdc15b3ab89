"""What a probe's similarity to a template of nobody is expected to be, and how it varies.

A *wolf* probe lies near everybody's template, and so near those of nobody as well. Its similarity
to one subject must therefore exceed what is expected of it by a calibrated number of deviations
(docs/method.md "Scores"). Of points both are known in closed form; lifted probes are held against a
cohort (T-norm).
"""

import numpy as np
from numpy.typing import NDArray

from templates.contract.nobody import LEAST_SPREAD, Nobody
from templates.distances import Metric, pairwise_distances, similarity
from templates.space.subspace import SubspaceBatch

Probes = NDArray[np.float32] | SubspaceBatch


def expected_similarity(
    probes: Probes, nobody: Nobody, *, metric: Metric, steps: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation that are expected of every probe, each (P,)."""
    if not isinstance(probes, SubspaceBatch):
        return nobody.statistics(probes, metric)
    distances = pairwise_distances(probes, nobody.cohort, metric=metric, steps=steps)
    similarities = np.asarray(similarity(distances), dtype=np.float64)
    spread = np.maximum(similarities.std(axis=1, ddof=1), LEAST_SPREAD)
    return similarities.mean(axis=1), spread
