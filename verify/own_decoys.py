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
from verify.consistency import impostor_cosines, impostor_tail
from verify.evaluation.attributes import resembling_rows

LEAST_DEVIATIONS = 4
"""Standard deviations below chance from which on axes correlate too little."""
MOST_PEOPLE = 0.02
SAME_PHOTO = 0.999
"""Cosine of a photo to itself, encoded again."""

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
    """Refuse decoys that were made of the people who are to be calibrated on.

    A generator must not be fitted to these embeddings or most of them; at most one in fifty people
    may have a pool entry that is as alike as two photos of one person are.

    Parameters
    ----------
    embeddings, identities : (N, n) float32 unit rows, N names
        Of the calibration, without those that are left out of it.
    """
    names, person = np.unique(np.asarray(identities, dtype=np.str_), return_inverse=True)
    firsts = np.unique(person, return_index=True)[1]
    if isinstance(source, DecoyGenerator):
        if any(was_fitted_to(source, rows) for rows in (embeddings, embeddings[firsts])):
            raise ContractError(
                "the decoys were made of the photos of these people, or of most of them: " + _REMEDY
            )
    elif isinstance(source, DecoyPool):
        likeness = _likeness(embeddings, person, entries=len(source))
        rows = resembling_rows(embeddings, source.entries[0], cosine=likeness)
        known = len(np.unique(person[rows]))
        if known > max(1, MOST_PEOPLE * len(names)):
            raise ContractError(
                f"the decoy pool seems to hold {known} of these {len(names)} people: {_REMEDY}"
            )


def _likeness(embeddings: NDArray[np.float32], person: NDArray[np.int64], *, entries: int) -> float:
    """Cosine from which on a pool entry is taken for a photo of a person of the calibration.

    The median cosine of two photos of one person, or more where strangers are so alike that one
    person in a hundred would have such an entry by chance.
    """
    order = np.argsort(person, kind="stable")
    same = person[order][1:] == person[order][:-1]
    pairs = order[:-1][same], order[1:][same]
    genuine = np.einsum("ij,ij->i", embeddings[pairs[0]], embeddings[pairs[1]])
    tail = impostor_tail(impostor_cosines(embeddings, person, rng=np.random.default_rng(0)))
    tries = entries * len(embeddings) / (person.max() + 1)
    chance = min(tail.at(MOST_PEOPLE / 2 / tries), SAME_PHOTO)
    return max(float(np.median(genuine)) if len(genuine) else SAME_PHOTO, chance)
