"""The nearest of the attacker's faces to a template: the paper's attack (its §4.3).

A template and a face are compared by the point-to-subspace distance. Both metrics come from the
same products, so they are searched together. Gallery and templates are taken a tile at a time, and
only the K best of every template are kept: memory does not grow with the number of pairs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.crossgram import point_tiles
from templates.distances import Metric, paired_distances
from templates.subspace import SubspaceBatch

Floats = NDArray[np.float32]
Codes = NDArray[np.int64]
Attacked = Floats | SubspaceBatch
"""Raw descriptors (P, n), or templates of P faces."""
Advance = Callable[[int], None]
"""Called with a number of (template, face) pairs that are done."""

METRICS = (Metric.EUCLIDEAN, Metric.SPHERICAL)
# Below this, squared distances in float32 have lost digits to cancellation.
_NEAR = 0.1
_GALLERY_ROWS = 4096
_ATTACKED_ROWS = 512
# Enough to settle ties of the vote, too little to outweigh a neighbour (K is at most _MOST).
_MOST = 1000
_TIE = 1e-4


@dataclass(frozen=True, eq=False, repr=False)
class Neighbours:
    """The K nearest faces of every template, nearest first.

    Parameters
    ----------
    indices : (P, K) int64
        Positions in the gallery.
    distances : (P, K) float32
    """

    indices: Codes
    distances: Floats


def nearest_neighbours(
    attacked: Attacked,
    gallery: Floats,
    *,
    k: int,
    metrics: Sequence[Metric] = METRICS,
    skip: Codes | None = None,
    progress: Advance | None = None,
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
    metrics
        Those to search by.
    skip : (P,) int64, optional
        Position in the gallery that each template does not find: that of the face in it, where the
        attacker lifted faces of the gallery. The gallery must have more than ``k`` faces then.
    progress
        Called after every tile with the number of pairs that it held.

    Returns
    -------
    By metric. Of equally near faces the first of the gallery comes first. Distances below 0.1 are
    computed again in float64.

    Raises
    ------
    AuditError
        ``k`` is out of range, or the dimensions differ.

    References
    ----------
    Paper eq. 1; METHOD §3.
    """
    n = attacked.n if isinstance(attacked, SubspaceBatch) else attacked.shape[1]
    there = len(gallery) - (skip is not None)
    if not 1 <= k <= min(_MOST, there) or gallery.shape[1] != n:
        raise AuditError(
            f"{k} neighbours of templates of {n} numbers cannot be found among {len(gallery)} "
            f"faces of {gallery.shape[1]} numbers; K must be 1 to {_MOST}"
        )
    best = {metric: _Best.empty(len(attacked), k) for metric in metrics}
    for first in range(0, len(attacked), _ATTACKED_ROWS):
        mine = slice(first, min(first + _ATTACKED_ROWS, len(attacked)))
        for start in range(0, len(gallery), _GALLERY_ROWS):
            tile = gallery[start : start + _GALLERY_ROWS]
            for metric, keys in _keys(attacked[mine], tile, metrics).items():
                if skip is not None:
                    _forget(keys, skip[mine] - start)
                best[metric].merge(mine, keys, start)
            if progress is not None:
                progress((mine.stop - mine.start) * len(tile))
    return {metric: _exact(found, attacked, gallery, metric) for metric, found in best.items()}


def merged(first: Neighbours, second: Neighbours, *, after: int, k: int) -> Neighbours:
    """Return the k nearest of two searches, the second of the gallery's faces from ``after`` on."""
    distances = np.concatenate([first.distances, second.distances], axis=1)
    indices = np.concatenate([first.indices, second.indices + after], axis=1)
    order = np.lexsort((indices, distances), axis=1)[:, :k]
    return Neighbours(
        np.take_along_axis(indices, order, 1), np.take_along_axis(distances, order, 1)
    )


def votes(neighbours: Neighbours, labels: Codes, classes: int, *, k: int) -> Floats:
    """Share of the k nearest neighbours in each class.

    Parameters
    ----------
    neighbours
        With K ≥ k.
    labels : (G,) int64
        Class numbers of the gallery.

    Returns
    -------
    float32, shape (P, classes)
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


@dataclass(frozen=True, eq=False, repr=False)
class _Best:
    """The K least keys of every template so far, in order; updated in place."""

    keys: Floats
    indices: Codes

    @classmethod
    def empty(cls, count: int, k: int) -> "_Best":
        return cls(
            np.full((count, k), np.inf, dtype=np.float32), np.full((count, k), -1, dtype=np.int64)
        )

    def merge(self, rows: slice, keys: Floats, offset: int) -> None:
        k = self.keys.shape[1]
        place = np.tile(np.arange(keys.shape[1], dtype=np.int64), (len(keys), 1))
        if keys.shape[1] > k:
            place = np.argpartition(keys, k - 1, axis=1)[:, :k]
        all_keys = np.concatenate([self.keys[rows], np.take_along_axis(keys, place, 1)], axis=1)
        all_places = np.concatenate([self.indices[rows], place + offset], axis=1)
        order = np.lexsort((all_places, all_keys), axis=1)[:, :k]
        self.keys[rows] = np.take_along_axis(all_keys, order, 1)
        self.indices[rows] = np.take_along_axis(all_places, order, 1)


def _forget(keys: Floats, columns: Codes) -> None:
    """Make one column of every row the last, where it lies in this tile."""
    rows = np.flatnonzero((columns >= 0) & (columns < keys.shape[1]))
    keys[rows, columns[rows]] = np.inf


def _keys(attacked: Attacked, tile: Floats, metrics: Sequence[Metric]) -> dict[Metric, Floats]:
    """Numbers that order the tile's faces as their distances do, shape (P, faces)."""
    if not isinstance(attacked, SubspaceBatch):
        squared = np.asarray(2 - 2 * (attacked @ tile.T), dtype=np.float32)
        return {metric: squared.copy() for metric in metrics}
    out = {m: np.empty((len(attacked), len(tile)), dtype=np.float32) for m in metrics}
    squares = (attacked.foot_norms**2).astype(np.float32)
    radii = attacked.radii.astype(np.float32)
    for rows, columns, dots, spreads in point_tiles(tile, attacked, np.dtype(np.float32)):
        if Metric.EUCLIDEAN in out:
            out[Metric.EUCLIDEAN][columns, rows] = 1 + squares[columns, None] - 2 * dots - spreads
        if Metric.SPHERICAL in out:
            similar = dots + radii[columns, None] * np.sqrt(spreads)
            out[Metric.SPHERICAL][columns, rows] = 2 - 2 * similar
    return out


def _exact(best: _Best, attacked: Attacked, gallery: Floats, metric: Metric) -> Neighbours:
    """Distances of the squares found; the small ones anew, and the rows that have some in order."""
    distances = np.sqrt(np.maximum(best.keys, 0))
    indices = best.indices
    i, j = np.nonzero(distances < _NEAR)
    if i.size:
        for start in range(0, i.size, _ATTACKED_ROWS):
            rows, columns = i[start : start + _ATTACKED_ROWS], j[start : start + _ATTACKED_ROWS]
            faces = gallery[indices[rows, columns]]
            if isinstance(attacked, SubspaceBatch):
                again = paired_distances(faces, attacked[rows], metric=metric, dtype=np.float64)
            else:
                gap = faces.astype(np.float64) - attacked[rows]
                again = np.linalg.norm(gap, axis=1)
            distances[rows, columns] = again
        order = np.lexsort((indices, distances), axis=1)
        distances = np.take_along_axis(distances, order, 1)
        indices = np.take_along_axis(indices, order, 1)
    return Neighbours(indices, distances)
