"""What a probe's similarity to a template of nobody is expected to be, and how it varies.

A *wolf* probe lies near everybody's template, and so near those of nobody as well. Its similarity
to one subject must therefore exceed what is expected of it by a calibrated number of deviations
(docs/decision.md §1). Of points both are known in closed form; lifted probes are held against a
cohort (T-norm).
"""

import numpy as np
from numpy.typing import NDArray

from templates.contract.document import Contract
from templates.contract.expectation import LEAST_SPREAD
from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.decoys.fitting import MIN_DESCRIPTORS
from templates.distances import Metric, pairwise_distances, similarity
from templates.space.rounded import RoundedBatch
from templates.space.subspace import SubspaceBatch

Probes = NDArray[np.float32] | SubspaceBatch


def client_source(source: DecoySource) -> DecoySource:
    """Return the generator that lifting clients receive, never a pool.

    A generator is returned as it is; to a pool one is fitted, always the same for the same pool.
    """
    return source.fitted if isinstance(source, DecoyPool) else source


def people_like(source: DecoySource, people: NDArray[np.float32] | None) -> DecoySource:
    """Return what draws descriptors that are spread like those of enrolled people (P, n).

    Decoys are fitted to other people, and to single photos. So a generator is fitted to the people
    where they are n or more, and enough for a fit; otherwise it is ``source`` without the noise
    that lifting adds. A wolf that knows how templates of nobody differ from real ones is nearer to
    the real ones, and passes too often.
    """
    if people is not None and len(people) >= max(people.shape[1], MIN_DESCRIPTORS):
        return DecoyGenerator.fit(people)
    return source.without_noise() if isinstance(source, DecoyGenerator) else source


def cohort_statistics(
    probes: SubspaceBatch, cohort: SubspaceBatch | RoundedBatch, *, metric: Metric, steps: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation of every lifted probe's similarities to the cohort, each (P,)."""
    distances = pairwise_distances(probes, cohort, metric=metric, steps=steps)
    similarities = np.asarray(similarity(distances), dtype=np.float64)
    spread = np.maximum(similarities.std(axis=1, ddof=1), LEAST_SPREAD)
    return similarities.mean(axis=1), spread


def expected_similarity(
    probes: Probes, contract: Contract, *, metric: Metric, steps: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation that a contract expects of every probe, each (P,)."""
    if isinstance(probes, SubspaceBatch):
        return cohort_statistics(probes, contract.cohort, metric=metric, steps=steps)
    return contract.expectation.statistics(probes)
