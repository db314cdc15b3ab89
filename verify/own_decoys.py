"""Whether decoys were made of the very people that a calibration measures.

Such decoys resemble the enrolled people more than those of a deployment resemble its users: the
calibration then measures something that nobody will see. A generator holds no embedding and names
nobody, but along its axes the faces that it was made of do not correlate, and others do.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.errors import ContractError
from verify.consistency import impostor_cosines, lax_and_strict
from verify.evaluation.attributes import resembling_rows

LEAST_DEVIATIONS = 4
"""Standard deviations below chance from which on axes correlate too little."""
MOST_PEOPLE = 0.02
"""Share of the people who may have an entry of a pool that looks like them."""

_REMEDY = (
    "such a calibration says nothing about people who are not among the decoys. Build the decoys "
    "from other people's photos of the same kind, or leave these people out (`decoys build "
    "--exclude`, `calibrate --exclude-people`)"
)


def was_fitted_to(generator: DecoyGenerator, embeddings: NDArray[np.floating]) -> bool:
    """Whether (N, n) unit embeddings correlate less along a generator's axes than chance has it.

    The mean squared correlation of two axes, times N, is 0 for the embeddings of the fit. For other
    people it is 1 by chance alone, and more where they are of another kind or several photos of
    one person.
    """
    turn = np.linalg.eigh(generator.covariance)[1][:, ::-1]
    scores = np.asarray(embeddings, dtype=np.float64) @ generator.axes.astype(np.float64) @ turn
    # The leading axes carry clusters, such as gender, which correlate in any part of the people.
    scores = scores[:, generator.k // 4 :]
    scores -= scores.mean(axis=0)
    # Faces fewer than their numbers do not vary on some axes of their own fit but by rounding.
    lengths = np.linalg.norm(scores, axis=0)
    scores = scores[:, lengths > 1e-4 * lengths.max()]
    if scores.shape[1] < 2:  # nothing to correlate
        return False
    scores /= np.linalg.norm(scores, axis=0)
    squares = (scores.T @ scores) ** 2
    pairs = squares.shape[0] * (squares.shape[0] - 1)
    correlation = len(scores) * float(squares.sum() - np.trace(squares)) / pairs
    # Of each unordered pair, a square of variance 2 where the mean is 1.
    return bool(correlation < 1 - LEAST_DEVIATIONS * np.sqrt(2 / (pairs / 2)))


def require_others(
    source: DecoySource, embeddings: NDArray[np.float32], identities: Sequence[str]
) -> None:
    """Refuse decoys that were made of the people of a calibration.

    A generator must not be fitted to them or most of them, a pool not hold more of them than by
    chance. ``embeddings`` are (N, n) float32 unit rows of the calibration, without those that are
    left out of it, and ``identities`` their N names.
    """
    _, firsts, person = np.unique(
        np.asarray(identities, dtype=np.str_), return_index=True, return_inverse=True
    )
    if isinstance(source, DecoyGenerator) and any(
        was_fitted_to(source, rows) for rows in (embeddings, embeddings[firsts])
    ):
        raise ContractError(
            "the decoys were made of the photos of these people, or of most of them: " + _REMEDY
        )
    if isinstance(source, DecoyPool):
        impostor = impostor_cosines(embeddings, person, rng=np.random.default_rng(0))
        # At this FMR half of `MOST_PEOPLE` resemble an entry by chance.
        _, likeness = lax_and_strict(impostor, MOST_PEOPLE / 2 / len(source))
        known = len(resembling_rows(embeddings[firsts], source.entries[0], cosine=likeness))
        if known > max(1, MOST_PEOPLE * len(firsts)):
            raise ContractError(
                f"the decoy pool seems to hold {known} of these {len(firsts)} people: {_REMEDY}"
            )
