"""The strangers of a contract: who they are, and how near an honest template lies to them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from templates.contract.expectation import PointExpectation
from templates.contract.nobody import Nobody
from templates.decoys import DecoyGenerator, DecoySource
from templates.errors import ContractError, DecoyError
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.subspace import SubspaceBatch
from verify.cohort import client_source, people_like

STRANGERS = 1_000
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
        What descriptors of nobody are drawn from (:func:`verify.cohort.people_like`).
    photos : (N, n) float32
        Descriptors of the calibration. Where ``hidden`` is ``source`` without its noise, people are
        fewer than n; then one generator is fitted to the photos of every second of them, and one to
        the others, where that is possible: of those who were fitted to a few people, many lie near
        them.
    person_of : (N,) int64
        Person of every photo.

    Returns
    -------
    tuple
        One source; or that of people with even numbers, and that of those with odd ones.
    """
    if hidden.source_id != people_like(source, None).source_id:
        return (hidden,)
    halves = [photos[person_of % 2 == half] for half in (0, 1)]
    try:
        return tuple(DecoyGenerator.fit(half[:: -(-len(half) // _FITTED) or 1]) for half in halves)
    except DecoyError:
        # They are too few, hardly vary, or lie in a small subspace.
        return (hidden,)


def make_nobody(
    source: DecoySource,
    *,
    strangers: Sequence[DecoySource],
    stream: Keystream,
    size: int = STRANGERS,
) -> Nobody:
    """Draw strangers who do not exist, and the seed of a cohort.

    Parameters
    ----------
    strangers
        What they are drawn from, in equal shares (:func:`strangers_like`).
    stream
        Fresh for a service: strangers and seed are secrets.
    """
    generator = client_source(source)
    if not isinstance(generator, DecoyGenerator):
        raise ContractError("strangers are lifted with a decoy generator")
    share = size // len(strangers)
    people = np.concatenate([crowd.draw(share, 1, stream=stream)[:, 0] for crowd in strangers])
    return Nobody.of(people, generator, seed=stream.token(KEY_BYTES))


def honest_score(
    nobody: Nobody,
    expectation: PointExpectation,
    templates: SubspaceBatch,
    *,
    people: NDArray[np.int64] | None = None,
) -> float:
    """Largest score of an honest template: what a Gaussian reaches once in a thousand million.

    A bound for one more template, so it is wider where few were seen.

    Parameters
    ----------
    templates
        Of the calibration's people; the first ``SCORED`` count.
    people
        Their numbers, where the strangers are of two sources (:func:`strangers_like`): each
        template is then held against those that its person had no part in.
    """
    middle = len(nobody) // 2
    chosen = templates[:SCORED]
    scores = np.empty(len(chosen))
    if people is None:
        scores[:] = nobody.scores(chosen, expectation)
    else:
        for half, rows in enumerate((slice(middle, None), slice(middle))):
            own = np.flatnonzero(people[:SCORED] % 2 == half)
            if len(own):
                scores[own] = nobody.scores(chosen[own], expectation, rows=rows)
    count = len(scores)
    reach = -stdtrit(count - 1, ndtr(-DEVIATIONS)) * np.sqrt(1 + 1 / count)
    return float(np.mean(scores) + reach * np.std(scores, ddof=1))
