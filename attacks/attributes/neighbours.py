"""The nearest of the attacker's faces to a template: the attack of paper §4.3.

A template and a face are compared by the point-to-subspace distance, as
``templates.distances.nearest`` does it: memory does not grow with the number of pairs.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.distances import Metric, Neighbours, nearest
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Codes = NDArray[np.int64]
Attacked = Array32 | SubspaceBatch
"""Raw descriptors (P, n), or templates of P faces."""

METRICS = (Metric.EUCLIDEAN, Metric.SPHERICAL)
_BYTES = 32 << 20
# Enough to settle ties of the vote, too little to outweigh a neighbour (K is at most _MOST).
_MOST = 1000
_TIE = 1e-4


def nearest_neighbours(
    attacked: Attacked,
    gallery: Array32,
    *,
    k: int,
    metrics: Sequence[Metric] = METRICS,
    skip: Codes | None = None,
) -> Mapping[Metric, Neighbours]:
    """Search the gallery for the faces nearest to each template.

    Parameters
    ----------
    attacked : (P, n) float32 or SubspaceBatch of P
        Of raw descriptors both metrics are the distance of two points.
    gallery : (G, n) float32
        Unit rows.
    k
        Number of neighbours, at most G and 1,000.
    skip : (P,) int64, optional
        Position in the gallery that each template does not find: that of the face in it, where the
        attacker lifted faces of the gallery. The gallery must have more than ``k`` faces then.

    Returns
    -------
    By metric, of shape (P, K). Of equally near faces the first of the gallery comes first.
    Distances below 0.1 are computed in float64.

    Raises
    ------
    AuditError
        ``k`` is out of range, or the dimensions differ.

    References
    ----------
    Paper eq. 1; docs/method.md §3.1.
    """
    n = attacked.n if isinstance(attacked, SubspaceBatch) else attacked.shape[1]
    there = len(gallery) - (skip is not None)
    if not 1 <= k <= min(_MOST, there) or gallery.shape[1] != n:
        raise AuditError(
            f"{k} neighbours of templates of {n} numbers cannot be found among {len(gallery)} "
            f"faces of {gallery.shape[1]} numbers; K must be 1 to {_MOST}"
        )
    if not isinstance(attacked, SubspaceBatch):
        nearest_points = _nearest_points(attacked, gallery, k, skip)
        return dict.fromkeys(metrics, nearest_points)
    labels = None if skip is None else (np.arange(len(gallery), dtype=np.int64), skip)
    return {
        metric: nearest(
            gallery,
            attacked,
            k=k,
            metric=metric,
            of_templates=True,
            labels=labels,
        )
        for metric in metrics
    }


def _nearest_points(attacked: Array32, gallery: Array32, k: int, skip: Codes | None) -> Neighbours:
    indices = np.empty((len(attacked), k), dtype=np.int64)
    distances = np.empty((len(attacked), k), dtype=np.float32)
    step = max(1, _BYTES // (12 * len(gallery) + 8 * k * gallery.shape[1]))
    for start in range(0, len(attacked), step):
        rows = slice(start, min(start + step, len(attacked)))
        far = 1 - attacked[rows] @ gallery.T
        if skip is not None:
            in_gallery = np.flatnonzero(skip[rows] >= 0)
            far[in_gallery, skip[rows][in_gallery]] = np.inf
        candidates = np.argsort(far, axis=1, kind="stable")[:, :k]
        gaps = attacked[rows, None].astype(np.float64) - gallery[candidates]
        near = np.sqrt(np.einsum("pki,pki->pk", gaps, gaps))
        order = np.lexsort((candidates, near), axis=1)
        indices[rows] = np.take_along_axis(candidates, order, 1)
        distances[rows] = np.take_along_axis(near, order, 1)
    return Neighbours(indices, distances)


def merged(first: Neighbours, second: Neighbours, *, after: int, k: int) -> Neighbours:
    """Return the k nearest of two searches, the second of the gallery's faces from ``after`` on."""
    distances = np.concatenate([first.distances, second.distances], axis=1)
    indices = np.concatenate([first.indices, second.indices + after], axis=1)
    order = np.lexsort((indices, distances), axis=1)[:, :k]
    return Neighbours(
        np.take_along_axis(indices, order, 1), np.take_along_axis(distances, order, 1)
    )


def votes(neighbours: Neighbours, labels: Codes, classes: int, *, k: int) -> Array32:
    """Share of the k nearest neighbours in each class, (P, classes) float32.

    Parameters
    ----------
    neighbours
        With K ≥ k.
    labels : (G,) int64
        Class numbers of the gallery.
    """
    of = labels[neighbours.indices[:, :k]]
    return np.stack([(of == code).mean(axis=1) for code in range(classes)], axis=1).astype(
        np.float32
    )


def vote(neighbours: Neighbours, labels: Codes, classes: int, *, k: int) -> Codes:
    """Class that most of the k nearest neighbours have, shape (P,) int64.

    Of equally many, the class whose neighbours come first: a nearer neighbour weighs a little
    more, and all such extras together weigh less than one neighbour.
    """
    of = labels[neighbours.indices[:, :k]]
    weights = 1 + _TIE * 2.0 ** -np.arange(of.shape[1])
    scores = np.stack([(of == code) @ weights for code in range(classes)], axis=1)
    return np.asarray(np.argmax(scores, axis=1), dtype=np.int64)
