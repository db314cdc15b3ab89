"""Distances of all probes to all templates, a tile at a time, on compiled kernels and all cores.

One tile is the product of the stacked rows [p; D] of some probes and some templates
(docs/distances.md "The way of a pair"), made by the matrix library and solved by a kernel while it
is in the cache. Memory is bounded by the tiles of the threads. A search visits all tiles and keeps
something of each: all of it, the nearest, or counts. Every thread has a collector of its own; what
they hold together does not depend on which thread got which tile.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from templates.distances import exact
from templates.distances.blas import single_threaded
from templates.distances.kernels.arguments import Array32, Options, Result, Tile
from templates.distances.kernels.euclidean import scratch_size as euclidean_scratch
from templates.distances.kernels.lanes import LANES
from templates.distances.kernels.selection import count_within, keep_nearest
from templates.distances.kernels.spherical import scratch_size as spherical_scratch
from templates.distances.kernels.tiles import Grid, Sides, Space, compute, pack, solve, square
from templates.distances.metric import (
    ACCURACY,
    DEFAULT_STEPS,
    NEAR,
    Indices,
    Labels,
    Metric,
    Neighbours,
    Progress,
    parts,
)
from templates.distances.threads import share
from templates.space.subspace import SubspaceBatch

Probes = Array32 | SubspaceBatch

# Rows of the product of a tile; the probes have half: 2 MiB.
_TILE_SIDE = 1024
_FLAT = 2
# Numbers that one thread stacks sooner than several.
_SMALL_BLOCK = 1 << 22
_BLOCK_BYTES = 32 << 20
_PAIRED_BYTES = 8 << 20
# Multiplications, about half a millisecond's, below which another thread does not pay.
_LEAST = 1 << 25
_MOST_THREADS = 64
_MOST_SPARE = 16
_SPARE_BYTES = 16 << 20
_SHORT = np.float32(1e-12)
_TINY = np.float32(np.finfo(np.float32).tiny)
_NO_LABELS = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)

_Kept = TypeVar("_Kept", bound="_Nearest | _Counts")


# --- what is asked for ---------------------------------------------------------------------------


def pairwise(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric,
    steps: int,
    threads: int | None = None,
) -> Array32:
    """All distances, (P, T)."""
    out = np.empty((len(probes), len(templates)), dtype=np.float32)
    solver = _Solver(probes, templates, metric, steps)
    with _spaces(solver, threads, collecting=False) as spaces:
        for block in solver.blocks(len(spaces)):
            rows = out[block.first : block.first + block.grid.probes]

            def work(block: _Block, space: _ThreadSpace, rows: Array32 = rows) -> None:
                while solver.compute(block, space, rows.reshape(-1), len(templates)) >= 0:
                    pass

            def correct(number: int, block: _Block = block, rows: Array32 = rows) -> None:
                solver.correct(block, number, rows[block.grid.tile(number)])

            block.run(work, spaces)
            share(correct, np.flatnonzero(block.inexact).tolist(), len(spaces))
    return out


def nearest(
    probes: Probes,
    templates: SubspaceBatch,
    k: int,
    *,
    of_templates: bool,
    labels: Labels | None,
    **options: Any,
) -> Neighbours:
    """Find the K nearest; see ``templates.distances.nearest``."""
    count = len(templates) if of_templates else len(probes)

    def collector() -> _Nearest:
        return _Nearest(count, k, labels or _NO_LABELS, of_templates=of_templates)

    parts = traverse(probes, templates, collector, **options) or [collector()]
    distances = np.concatenate([part.distances for part in parts], axis=1)
    indices = np.concatenate([part.indices for part in parts], axis=1)
    # An empty place is behind everything, as it is inside one collector.
    last = np.where(indices < 0, np.iinfo(np.int64).max, indices)
    order = np.lexsort((last, distances), axis=1)[:, :k]
    return Neighbours(
        np.take_along_axis(indices, order, 1), np.take_along_axis(distances, order, 1)
    )


def counts_within(
    probes: Probes,
    templates: SubspaceBatch,
    thresholds: NDArray[np.float64],
    *,
    labels: Labels | None,
    **options: Any,
) -> Indices:
    """Count the pairs up to every threshold; thresholds ascend."""
    # The largest float32 that is not above: d <= t for float32 d either way.
    limits = thresholds.astype(np.float32)
    limits = np.where(limits > thresholds, np.nextafter(limits, np.float32(-np.inf)), limits)
    parts = traverse(probes, templates, lambda: _Counts(limits, labels or _NO_LABELS), **options)
    return np.cumsum(sum((part.counts for part in parts), np.zeros(len(limits), dtype=np.int64)))


def paired(
    probes: SubspaceBatch, templates: SubspaceBatch, *, metric: Metric, steps: int
) -> Array32:
    """Distances of probe i to template i, (P,)."""
    out = np.empty(len(probes), dtype=np.float32)
    solver = _Solver(probes, templates, metric, steps)
    numbers = (probes.m + templates.m + 2) * probes.n + (probes.m + 1) * (templates.m + 1)
    with single_threaded():
        for part in parts(len(probes), max(1, _PAIRED_BYTES // (4 * numbers))):
            out[part] = solver.paired(part)
    return out


def warm_up() -> None:
    """Compile every kernel, or load it from its cache."""
    rng = np.random.default_rng(0)
    rows = np.linalg.qr(rng.normal(size=(8, 24, 4)))[0].transpose(0, 2, 1).astype(np.float32)
    batch = SubspaceBatch(rows[:, 0], np.ascontiguousarray(rows[:, 1:]))
    options: dict[str, Any] = {"metric": Metric.EUCLIDEAN, "steps": DEFAULT_STEPS}
    pairwise(batch.feet, batch, threads=1, **options)
    paired(batch, batch, **options)
    nearest(batch, batch, 1, of_templates=False, labels=None, threads=1, **options)
    counts_within(batch, batch, np.ones(1), labels=None, threads=1, **options)


# --- what is kept --------------------------------------------------------------------------------


class _Nearest:
    """The k nearest templates of every probe, or probes of every template."""

    def __init__(self, count: int, k: int, labels: Labels, *, of_templates: bool) -> None:
        self.distances = np.full((count, k), np.inf, dtype=np.float32)
        self.indices = np.full((count, k), -1, dtype=np.int64)
        self._labels, self._of_templates = labels, of_templates

    def take(self, rows: slice, columns: slice, distances: Array32) -> None:
        """Merge a tile."""
        row_labels, column_labels = self._labels[0][rows], self._labels[1][columns]
        if self._of_templates:
            height, width = rows.stop - rows.start, columns.stop - columns.start
            turned = np.empty((width, _whole(height)), dtype=np.float32)
            turned[:, :height] = distances.reshape(height, -1)[:, :width].T
            distances = turned.reshape(-1)
            rows, columns, row_labels, column_labels = columns, rows, column_labels, row_labels
        count, best, places = columns.stop - columns.start, self.distances, self.indices
        keep_nearest(
            distances, count, columns.start, row_labels, column_labels, best[rows], places[rows]
        )


class _Counts:
    """Numbers of pairs by threshold; thresholds ascend."""

    def __init__(self, thresholds: Array32, labels: Labels) -> None:
        self.counts = np.zeros(len(thresholds), dtype=np.int64)
        self._thresholds, self._labels = thresholds, labels

    def take(self, rows: slice, columns: slice, distances: Array32) -> None:
        """Count a tile."""
        row_labels, column_labels = self._labels[0][rows], self._labels[1][columns]
        count = columns.stop - columns.start
        count_within(distances, count, self._thresholds, row_labels, column_labels, self.counts)


def traverse(
    probes: Probes,
    templates: SubspaceBatch,
    collector: Callable[[], _Kept],
    *,
    metric: Metric,
    steps: int,
    threads: int | None = None,
    progress: Progress | None = None,
) -> list[_Kept]:
    """Let collectors take all tiles, (R · C,), one collector a thread; return them.

    C is the number of a tile's columns rounded up to 16.
    """
    solver = _Solver(probes, templates, metric, steps)
    collectors: dict[int, _Kept] = {}
    lock = threading.Lock()

    def visit(block: _Block, space: _ThreadSpace) -> None:
        while (number := solver.compute(block, space, space.distances, 0)) >= 0:
            kept = collectors.get(id(space)) or collectors.setdefault(id(space), collector())
            rows, columns = block.grid.tile(number)
            wide = _whole(columns.stop - columns.start)
            distances = space.distances[: (rows.stop - rows.start) * wide]
            if block.inexact[number]:
                solver.correct(block, number, distances.reshape(-1, wide))
            part = slice(rows.start + block.first, rows.stop + block.first)
            kept.take(part, columns, distances)
            if progress is not None:
                with lock:
                    progress((part.stop - part.start) * (columns.stop - columns.start))

    with _spaces(solver, threads, collecting=True) as spaces:
        for block in solver.blocks(len(spaces)):
            block.run(visit, spaces)
    return list(collectors.values())


# --- the memory of threads -----------------------------------------------------------------------


class _ThreadSpace:
    """Working space of one thread.

    Fresh memory costs more than a small tile: it comes page by page. So a finished traversal leaves
    its spaces to the next.
    """

    spare: list[Array32] = []  # noqa: RUF012

    def __init__(self, solver: "_Solver", *, collecting: bool) -> None:
        sizes = solver.sizes(collecting=collecting)
        self._used = sum(sizes)
        try:
            self._memory = self.spare.pop()
        except IndexError:
            self._memory = np.empty(0, dtype=np.float32)
        if len(self._memory) < self._used:
            self._memory = np.empty(self._used, dtype=np.float32)
        ends = np.cumsum(sizes)[:-1]
        packed, squares, product, work, distances = np.split(self._memory[: self._used], ends)
        work[:] = 0
        self.distances = distances
        self.kernel = Space(packed, squares, product, work, np.full(1, -1, dtype=np.int64))

    def leave(self) -> None:
        """Leave the memory to the next traversal, without anything of this one."""
        self._memory[: self._used] = 0
        if len(self.spare) < _MOST_SPARE and self._memory.nbytes <= _SPARE_BYTES:
            self.spare.append(self._memory)


@contextmanager
def _spaces(
    solver: "_Solver", threads: int | None, *, collecting: bool
) -> Iterator[list[_ThreadSpace]]:
    """Working spaces, as many as threads pay for a problem; the matrix library takes one each."""
    most = max(1, min(solver.tiles, solver.multiplications // _LEAST, _MOST_THREADS))
    with single_threaded() as available:
        count = min(threads or available, most)
        spaces = [_ThreadSpace(solver, collecting=collecting) for _ in range(count)]
        yield spaces
        for space in spaces:
            space.leave()


# --- one problem ---------------------------------------------------------------------------------


class _Block:
    """Stacked rows of some probes, and the tiles that they have with all templates."""

    def __init__(self, first: int, sides: Sides, grid: Grid) -> None:
        self.first, self.sides, self.grid = first, sides, grid
        self.counter = np.zeros(1, dtype=np.int64)
        self.inexact = np.zeros(grid.tiles, dtype=np.int64)

    def run(
        self, work: Callable[["_Block", _ThreadSpace], None], spaces: list[_ThreadSpace]
    ) -> None:
        """Let every thread work; where one fails, the other tiles are left."""

        def guarded(space: _ThreadSpace) -> None:
            try:
                work(self, space)
            except BaseException:
                self.counter[0] = self.grid.tiles
                raise

        share(guarded, spaces, len(spaces))


class _Solver:
    """One problem: its tiles, and a tile's distances."""

    def __init__(
        self,
        probes: Probes,
        templates: SubspaceBatch,
        metric: Metric,
        steps: int,
    ) -> None:
        self._probes, self._templates, self._metric = probes, templates, metric
        self._options = Options(
            metric is Metric.SPHERICAL, steps, np.float32(NEAR), np.float32(ACCURACY)
        )
        self._m = probes.m if isinstance(probes, SubspaceBatch) else 0
        width = LANES * max(1, _TILE_SIDE // ((templates.m + 1) * LANES))
        self._rows = _even(len(probes), max(1, _TILE_SIDE // _FLAT // (self._m + 1)))
        self._columns = _whole(_even(len(templates), width))

    @property
    def multiplications(self) -> int:
        """Of the product of all rows."""
        of_a_pair = (self._m + 1) * (self._templates.m + 1) * self._templates.n
        return len(self._probes) * len(self._templates) * of_a_pair

    @property
    def tiles(self) -> int:
        """Number of all tiles, at least."""
        return self._grid(len(self._probes)).tiles

    def _grid(self, probes: int) -> Grid:
        return Grid(probes, len(self._templates), max(1, self._rows), max(1, self._columns))

    @property
    def _scratch(self) -> int:
        if not self._m:
            return 0
        size = spherical_scratch if self._options.spherical else euclidean_scratch
        return size(self._m, self._templates.m)

    def sizes(self, *, collecting: bool) -> tuple[int, ...]:
        """Numbers that a thread needs for the largest tile: a ``Space``, and its distances."""
        m, pairs = self._templates.m, self._rows * self._columns
        packed, product = self._columns * (m + 1) * self._templates.n, pairs * (m + 1)
        product *= self._m + 1
        return packed, self._columns, product, self._scratch, pairs if collecting else 0

    def blocks(self, threads: int) -> Iterator[_Block]:
        """Stack the rows of the probes, block by block in the same memory."""
        if not self._columns:
            return
        numbers = max(1, self._rows) * (self._m + 1) * self._templates.n
        step = self._rows * max(1, _BLOCK_BYTES // (4 * numbers))
        stacked = None
        for part in parts(len(self._probes), step):
            if isinstance(self._probes, SubspaceBatch):
                count = part.stop - part.start
                if stacked is None:
                    stacked = np.empty((count, self._m + 1, self._templates.n), dtype=np.float32)
                terms = self._stack_probes(self._probes[part], stacked[:count], threads)
                rows = stacked[:count].reshape(-1, self._templates.n)
            else:
                rows, terms = self._take_points(self._probes[part])
            batch = self._templates
            assert isinstance(batch, SubspaceBatch)  # noqa: S101
            sides = Sides(_locked(rows), terms, self._m, batch.feet, batch.bases)
            yield _Block(part.start, sides, self._grid(len(terms)))

    def _take_points(self, points: Array32) -> tuple[Array32, Array32]:
        squares = _squares(points)
        if not self._options.spherical:
            return points, squares
        # Squares of very short and very long points do not fit float32.
        odd = np.flatnonzero((squares < _SHORT) | (squares > 1 / _SHORT))
        if odd.size:
            points = points.copy()
            points[odd] = exact.normalised(points[odd].astype(np.float64))
            squares = _squares(points)
        return points, np.reciprocal(np.sqrt(np.maximum(squares, _TINY)))

    def _stack_probes(self, probes: SubspaceBatch, stacked: Array32, threads: int) -> Array32:
        """Stack the rows of lifted probes, probe after probe; return the squares of their feet."""
        squares = np.empty(len(probes), dtype=np.float32)

        def one(part: slice) -> None:
            self._stack(probes[part], stacked[part])
            squares[part] = _squares(probes.feet[part])

        step = len(probes) if stacked.size < _SMALL_BLOCK else self._rows
        share(one, parts(len(probes), step), threads)
        return squares

    def _stack(self, batch: SubspaceBatch, stacked: Array32) -> None:
        feet, bases = stacked[:, 0], stacked[:, 1:]
        if self._options.spherical:
            scales, radii = (part.astype(np.float32) for part in exact.spheres(batch.feet))
            np.multiply(batch.feet, scales[:, None], out=feet)
            np.multiply(batch.bases, radii[:, None, None], out=bases)
        else:
            feet[:], bases[:] = batch.feet, batch.bases

    def compute(self, block: _Block, space: _ThreadSpace, out: Array32, stride: int) -> int:
        """Write the distances of some of the next tiles, −1 where they are not exact."""
        task = block.sides, block.grid, self._options, space.kernel, block.counter
        return compute(*task, out, stride, block.inexact)

    def correct(self, block: _Block, number: int, out: Array32) -> None:
        """Compute the pairs of a tile exactly that are −1 in ``out``, (R, T or more)."""
        rows, columns = block.grid.tile(number)
        table = out[:, : columns.stop - columns.start]
        i, j = np.nonzero(table < 0)
        if i.size:
            table[i, j] = self._exact(i + rows.start + block.first, j + columns.start)

    def paired(self, part: slice) -> Array32:
        """Distances of probes to the templates of the same positions."""
        probes, batch = self._probes[part], self._templates
        assert isinstance(probes, SubspaceBatch)  # noqa: S101
        assert isinstance(batch, SubspaceBatch)  # noqa: S101
        count, m_d, m_e, n = len(probes), self._m, batch.m, batch.n
        wide = _whole(count)
        left = np.empty((count, m_d + 1, n), dtype=np.float32)
        self._stack(probes, left)
        right = np.empty((m_e + 1, wide, n), dtype=np.float32)
        squares = np.empty(wide, dtype=np.float32)
        product = np.zeros((m_d + 1, m_e + 1, wide), dtype=np.float32)
        flat, work = product.reshape(-1), np.zeros(self._scratch, dtype=np.float32)
        space = Space(right.reshape(-1), squares, flat, work, np.zeros(1, dtype=np.int64))
        pack(batch.feet, batch.bases, part.start, count, self._options.spherical, space, wide)
        squares[:count] += _squares(probes.feet)
        with np.errstate(over="ignore", invalid="ignore"):  # such pairs are computed again
            product[:, :, :count] = (left @ right[:, :count].transpose(1, 2, 0)).transpose(1, 2, 0)
        out = np.empty(wide, dtype=np.float32)
        tile = Tile(flat, np.zeros(1, dtype=np.float32), squares, m_d, m_e)
        if solve(tile, self._options, work, Result(out, wide, count)):
            again = np.flatnonzero(out[:count] < 0)
            out[again] = self._exact(again + part.start, again + part.start)
        return out[:count]

    def _exact(self, i: Indices, j: Indices) -> NDArray[np.float64]:
        options: dict[str, Any] = {"metric": self._metric, "steps": self._options.steps}
        return exact.pairs(self._probes, self._templates, i, j, **options)


def _squares(rows: Array32) -> Array32:
    squares = np.empty(len(rows), dtype=np.float32)
    square(_locked(rows), squares)
    return squares


def _locked(array: Array32) -> Array32:
    """View that cannot be written, as those of a batch: kernels are compiled for one kind."""
    view = array.view()
    view.flags.writeable = False
    return view


def _whole(count: int) -> int:
    """Round up to whole vectors."""
    return count + -count % LANES


def _even(count: int, most: int) -> int:
    """Size of the parts of ``count`` that are equal, at most ``most``, and even in number."""
    parts = -(-count // most)
    return -(-count // (parts + parts % 2 if parts > 1 else 1))
