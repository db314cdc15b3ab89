"""The strangers of a contract: who they are, and how near an honest template lies to them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from templates.contract.nobody import Nobody
from templates.decoys import DecoyGenerator, DecoySource
from templates.distances import Metric
from templates.errors import ContractError, DecoyError
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from verify.cohort import client_source, cohort_statistics

STRANGERS = 2_000
SCORED = 600
"""Templates that the limit is set by, at most."""
DEVIATIONS = 6.0
"""Of a Gaussian, above the mean. Scores of honest templates have a longer tail: with 4, one in
1,000 would be refused of other people of the calibration's kind, and one in 300 of another kind
(docs/thresholds.md)."""
_FITTED = 4_000
"""Photos that strangers are fitted to, at most."""


def strangers_like(
    source: DecoySource,
    hidden: DecoySource,
    photos: NDArray[np.float32],
    person_of: NDArray[np.int64],
) -> tuple[DecoySource, ...]:
    """Return what draws strangers who are spread as the people of a calibration are.

    Parameters
    ----------
    source
        The decoys of clients: everybody may know it, so that a wolf can be made that lies near
        real faces, and not near those that it draws.
    hidden
        What the cohort's descriptors are drawn from (:func:`verify.cohort.people_like`).
    photos : (N, n) float32
        Descriptors of the calibration. Where ``hidden`` is ``source``, people are fewer than n;
        then one generator is fitted to the photos of every second of them, and one to the others,
        where that is possible: of those who were fitted to a few people, many lie near them.
    person_of : (N,) int64
        Person of every photo.

    Returns
    -------
    tuple
        One source; or that of people with even numbers, and that of those with odd ones.
    """
    if hidden is not source:
        return (hidden,)
    halves = [photos[person_of % 2 == half] for half in (0, 1)]
    try:
        return tuple(DecoyGenerator.fit(half[:: -(-len(half) // _FITTED) or 1]) for half in halves)
    except DecoyError:
        # They are too few, hardly vary, or lie in a small subspace.
        return (source,)


def make_nobody(
    source: DecoySource,
    *,
    strangers: Sequence[DecoySource],
    cohort: SubspaceBatch,
    metric: Metric,
    steps: int,
    stream: Keystream,
    size: int = STRANGERS,
) -> Nobody:
    """Draw strangers who do not exist.

    Parameters
    ----------
    source
        The contract's decoy source.
    strangers
        What they are drawn from, in equal shares (:func:`strangers_like`).
    cohort, metric, steps
        The contract's.
    stream
        Fresh for a service: the strangers are a secret.
    """
    generator = client_source(source)
    if not isinstance(generator, DecoyGenerator):
        raise ContractError("strangers are lifted with a decoy generator")
    share = size // len(strangers)
    people = np.concatenate([crowd.draw(share, 1, stream=stream)[:, 0] for crowd in strangers])
    means, spreads = cohort_statistics(people, cohort, metric=metric, steps=steps)
    return Nobody(people, means.astype(np.float32), spreads.astype(np.float32), generator)


def honest_score(
    nobody: Nobody, templates: SubspaceBatch, *, halves: bool, metric: Metric, steps: int
) -> float:
    """Largest score of an honest template: what a Gaussian reaches once in a thousand million.

    A bound for one more template, so it is wider where few were seen.

    Parameters
    ----------
    templates
        Of the calibration's people, in their order; the first ``SCORED`` count.
    halves
        Whether the strangers are of two sources: each template is then held against those that
        its person had no part in.
    """
    middle = len(nobody.people) // 2
    parts = [nobody[middle:], nobody[:middle]] if halves else [nobody]
    scores = [
        parts[number % len(parts)].score(template, metric=metric, steps=steps)
        for number, template in enumerate(templates[:SCORED])
    ]
    count = len(scores)
    reach = t.isf(norm.sf(DEVIATIONS), count - 1) * np.sqrt(1 + 1 / count)
    return float(np.mean(scores) + reach * np.std(scores, ddof=1))
