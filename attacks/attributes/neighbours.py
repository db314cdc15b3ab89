"""The nearest of the attacker's faces to a template, and their vote: the attack of paper §4.3."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from templates.distances import Metric, Neighbours, nearest
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Codes = NDArray[np.int64]
Attacked = Array32 | SubspaceBatch
"""Raw embeddings (P, n), or templates of P faces."""

METRICS = (Metric.EUCLIDEAN, Metric.SPHERICAL)
K = 10
"""Neighbours of the paper's attacker."""
_TIE = 1e-4
"""Of the vote: all that it adds together weighs less than one neighbour."""


def nearest_neighbours(
    attacked: Attacked, gallery: Array32, *, k: int, metrics: Sequence[Metric] = METRICS
) -> Mapping[Metric, Neighbours]:
    """Search the gallery, (G, n), for the k faces nearest to each template: by metric, (P, k).

    Of raw embeddings both metrics are the distance of two points (paper eq. 1, docs/method.md
    §3.1).
    """
    if isinstance(attacked, SubspaceBatch):
        return {metric: nearest(gallery, attacked, k=k, metric=metric) for metric in metrics}
    # Imported here: only an audit of attributes needs the library.
    from sklearn.neighbors import NearestNeighbors

    search = NearestNeighbors(n_neighbors=k, algorithm="brute").fit(gallery)
    distances, indices = search.kneighbors(attacked)
    points = Neighbours(indices.astype(np.int64), distances.astype(np.float32))
    return dict.fromkeys(metrics, points)


def votes(neighbours: Neighbours, labels: Codes, classes: int, *, k: int) -> Array32:
    """Share of the k nearest neighbours in each class, (P, classes); ``labels`` are (G,)."""
    of = labels[neighbours.indices[:, :k]]
    shares = [(of == code).mean(axis=1) for code in range(classes)]
    return np.stack(shares, axis=1).astype(np.float32)


def vote(neighbours: Neighbours, labels: Codes, classes: int, *, k: int) -> Codes:
    """Class that most of the k nearest neighbours have, shape (P,) int64.

    Of equally many, the class whose neighbours come first: a nearer neighbour weighs a little
    more.
    """
    of = labels[neighbours.indices[:, :k]]
    weights = 1 + _TIE * 2.0 ** -np.arange(of.shape[1])
    scores = np.stack([(of == code) @ weights for code in range(classes)], axis=1)
    return np.asarray(np.argmax(scores, axis=1), dtype=np.int64)
