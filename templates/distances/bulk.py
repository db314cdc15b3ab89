"""The float32 work of ``templates.distances`` on compiled kernels.

A search is a traversal of all tiles that keeps something of each: all of it, the nearest, or
counts. Every thread has a collector of its own; what they hold together does not depend on which
thread got which tile.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.distances.kernels.selection import count_within, keep_nearest
from templates.distances.metric import DEFAULT_STEPS, Labels, Metric
from templates.distances.rounded import RoundedSubspaces
from templates.distances.tiles import Floats, Probes, fill, paired_tile, traverse, whole
from templates.space.subspace import SubspaceBatch

Integers = NDArray[np.int64]

_NO_LABELS = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)


def matrix(
    probes: ArrayLike | SubspaceBatch, templates: SubspaceBatch, out: Floats, **options: Any
) -> None:
    """Write all distances to ``out``, (P, T) float32."""
    fill(_contiguous(probes), templates, out, **options)


def nearest(
    probes: ArrayLike | SubspaceBatch,
    templates: SubspaceBatch,
    k: int,
    *,
    of_templates: bool,
    labels: Labels | None,
    **options: Any,
) -> tuple[Integers, Floats]:
    """Indices and distances of the K nearest; see ``templates.distances.nearest``."""
    side = _contiguous(probes)
    count = len(templates) if of_templates else len(side)

    def collector() -> _Nearest:
        return _Nearest(count, k, labels or _NO_LABELS, of_templates=of_templates)

    parts = traverse(side, templates, collector, **options) or [collector()]
    distances = np.concatenate([part.distances for part in parts], axis=1)
    indices = np.concatenate([part.indices for part in parts], axis=1)
    # An empty place is behind everything, as it is inside one collector.
    last = np.where(indices < 0, np.iinfo(np.int64).max, indices)
    order = np.lexsort((last, distances), axis=1)[:, :k]
    return np.take_along_axis(indices, order, 1), np.take_along_axis(distances, order, 1)


def counts(
    probes: ArrayLike | SubspaceBatch,
    templates: SubspaceBatch,
    thresholds: NDArray[np.float64],
    *,
    labels: Labels | None,
    **options: Any,
) -> Integers:
    """Numbers of pairs up to every threshold, which ascend."""
    # The largest float32 that is not above: d <= t for float32 d either way.
    limits = thresholds.astype(np.float32)
    limits = np.where(limits > thresholds, np.nextafter(limits, np.float32(-np.inf)), limits)

    def collector() -> _Counts:
        return _Counts(limits, labels or _NO_LABELS)

    parts = traverse(_contiguous(probes), templates, collector, **options)
    total = np.zeros(len(limits), dtype=np.int64)
    for part in parts:
        total += part.counts
    return np.cumsum(total)


def paired(
    probes: SubspaceBatch, templates: SubspaceBatch, *, metric: Metric, steps: int
) -> Floats:
    """Distances of probe i to template i."""
    return paired_tile(probes, templates, metric=metric, steps=steps)


def _contiguous(probes: ArrayLike | SubspaceBatch) -> Probes:
    if isinstance(probes, SubspaceBatch):
        return probes
    return np.ascontiguousarray(probes, dtype=np.float32)


class _Nearest:
    """The K nearest templates of every probe, or probes of every template.

    Parameters
    ----------
    count
        Number of those that seek.
    k
        Number of places for each.
    of_templates
        Templates seek probes.
    """

    def __init__(self, count: int, k: int, labels: Labels, *, of_templates: bool) -> None:
        self.distances = np.full((count, k), np.inf, dtype=np.float32)
        self.indices = np.full((count, k), -1, dtype=np.int64)
        self._labels, self._of_templates = labels, of_templates

    def take(self, rows: slice, columns: slice, distances: Floats) -> None:
        """Merge a tile."""
        mine, theirs = self._labels[0][rows], self._labels[1][columns]
        if self._of_templates:
            table = _table(rows, columns, distances)
            rows, columns, mine, theirs = columns, rows, theirs, mine
            turned = np.empty((table.shape[1], whole(table.shape[0])), dtype=np.float32)
            turned[:, : table.shape[0]] = table.T
            distances = turned.reshape(-1)
        keep_nearest(
            distances,
            columns.stop - columns.start,
            columns.start,
            mine,
            theirs,
            self.distances[rows],
            self.indices[rows],
        )


class _Counts:
    """Numbers of pairs by threshold.

    Parameters
    ----------
    thresholds : (S,) float32
        Ascending.
    """

    def __init__(self, thresholds: Floats, labels: Labels) -> None:
        self.counts = np.zeros(len(thresholds), dtype=np.int64)
        self._thresholds, self._labels = thresholds, labels

    def take(self, rows: slice, columns: slice, distances: Floats) -> None:
        """Count a tile."""
        count_within(
            distances,
            columns.stop - columns.start,
            self._thresholds,
            self._labels[0][rows],
            self._labels[1][columns],
            self.counts,
        )


def _table(rows: slice, columns: slice, distances: Floats) -> Floats:
    count = columns.stop - columns.start
    return distances.reshape(rows.stop - rows.start, -1)[:, :count]


def warm_up() -> None:
    """Compile every kernel, or load it from its cache."""
    rng = np.random.default_rng(0)
    rows = np.linalg.qr(rng.normal(size=(8, 24, 4)))[0].transpose(0, 2, 1).astype(np.float32)
    batch = SubspaceBatch(rows[:, 0], np.ascontiguousarray(rows[:, 1:]))
    for metric in Metric:
        options = {"metric": metric, "steps": DEFAULT_STEPS, "threads": 1}
        matrix(batch, batch, np.empty((8, 8), dtype=np.float32), **options)
        matrix(rows[:, 0], batch, np.empty((8, 8), dtype=np.float32), **options)
    nearest(rows[:, 0], batch, 1, of_templates=False, labels=None, **options)
    counts(rows[:, 0], batch, np.ones(1), labels=None, **options)
    RoundedSubspaces.of(batch).similarities(rows[0, 0], metric=Metric.SPHERICAL)
