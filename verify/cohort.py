"""The cohort: templates that belong to nobody, against which every probe is normalised.

A *wolf* probe lies near everybody's template, and so near the cohort's as well. Its similarity to
one subject must therefore exceed its mean similarity to the cohort by a calibrated number of the
cohort's standard deviations (T-norm, docs/method.md §6.1).
"""

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.distances import Metric, pairwise_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

if TYPE_CHECKING:
    from templates.distances.rounded import RoundedSubspaces

COHORT_SIZE = 400
"""Templates in a cohort. The score of a wolf rests on the cohort's mean and standard deviation as
that wolf sees them, and with 150 their sampling error alone let single wolves reach 3 to 4 % of
templates at FMR 1e-2 (docs/thresholds.md); a larger cohort costs time at every decision."""
LEAST_SPREAD = 1e-6
"""Floor of the cohort's standard deviation: keeps the score finite for a probe that is equally
far from the whole cohort."""

Probes = NDArray[np.float32] | SubspaceBatch

# A pool may own a real person whom the cohort must not hold, so the cohort is lifted from
# generated descriptors with generated decoys; these strategies are then their plain forms.
_PLAIN = {
    Strategy.HYBRID_PLUS: Strategy.HYBRID,
    Strategy.SUB_HYBRID: Strategy.HYBRID,
    Strategy.SUB_ADVERSARIAL: Strategy.ADVERSARIAL,
}


def plain_strategy(strategy: Strategy) -> Strategy:
    """Return the form of a strategy that needs no labels and no sub-databases."""
    return _PLAIN.get(strategy, strategy)


def client_source(source: DecoySource) -> DecoySource:
    """Return the generator that lifting clients receive, never a pool.

    A generator is returned as it is; to a pool one is fitted, always the same for the same pool.
    """
    if not isinstance(source, DecoyPool):
        return source
    with Keystream.seeded("pool entries", source.source_id) as stream:
        entries = source.draw(1, len(source), stream=stream)[0]
    return DecoyGenerator.fit(entries[np.lexsort(entries.T)])


def people_like(source: DecoySource, people: NDArray[np.float32] | None) -> DecoySource:
    """Return what draws descriptors that are spread like those of enrolled people (P, n).

    Decoys are fitted to other people, and to single photos. So a generator is fitted to the people
    where they are n or more; otherwise it is ``source``.
    """
    if people is not None and len(people) >= people.shape[1]:
        return DecoyGenerator.fit(people)
    return source


def make_cohort(
    source: DecoySource,
    *,
    strategy: Strategy,
    m: int,
    stream: Keystream,
    size: int = COHORT_SIZE,
    hidden: DecoySource | None = None,
) -> SubspaceBatch:
    """Lift ``size`` descriptors of nobody, with decoys of nobody.

    The hidden descriptors should be spread like those of the templates that a probe meets: a wolf
    that knows a difference is nearer to the templates than to such a cohort, and passes too often.

    Parameters
    ----------
    source
        The contract's decoy source. A generator is drawn from; to a pool of real descriptors a
        generator is fitted first.
    strategy, m
        The contract's.
    hidden
        What the hidden descriptors are drawn from (:func:`people_like`); ``source`` where None.
    stream
        Fresh for a service; seeded for experiments only, since the cohort is a secret.

    Returns
    -------
    SubspaceBatch
        ``size`` templates, un-rotated.
    """
    nobody = client_source(source)
    descriptors = (hidden or nobody).draw(size, 1, stream=stream)[:, 0, :]
    return lift(descriptors, strategy=plain_strategy(strategy), m=m, source=nobody, stream=stream)


_rounded: "WeakKeyDictionary[SubspaceBatch, RoundedSubspaces]" = WeakKeyDictionary()


def rounded_cohort(cohort: SubspaceBatch) -> "RoundedSubspaces":
    """Return the form of a cohort that points are compared with; made once, at the first call."""
    # Commands that decide nothing shall not wait for the compiler's import.
    from templates.distances.rounded import RoundedSubspaces

    kept = _rounded.get(cohort)
    if kept is None:
        kept = _rounded[cohort] = RoundedSubspaces.of(cohort)
    return kept


def cohort_statistics(
    probes: Probes, cohort: SubspaceBatch, *, metric: Metric, steps: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation of every probe's similarities to the cohort, each (P,).

    Points are compared with the cohort rounded to eight bits, here and in a calibration alike: one
    decision would otherwise spend most of its time on reading the cohort.
    """
    if isinstance(probes, SubspaceBatch):
        distances = pairwise_distances(probes, cohort, metric=metric, steps=steps)
        similarities = np.asarray(similarity(distances), dtype=np.float64)
    else:
        rounded = rounded_cohort(cohort)
        similarities = np.array(
            [rounded.similarities(probe, metric=metric) for probe in probes], dtype=np.float64
        ).reshape(len(probes), len(cohort))
    spread = np.maximum(similarities.std(axis=1, ddof=1), LEAST_SPREAD)
    return similarities.mean(axis=1), spread
