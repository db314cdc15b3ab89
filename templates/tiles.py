"""Distances of all probes to all templates, a tile at a time, on compiled kernels and all cores.

One tile is the product of the stacked rows [p; D] of some probes and some templates (METHOD §5),
made by the matrix library and solved by a kernel while it is in the cache. Memory is bounded by the
tiles of the threads. A distance depends neither on the number of threads nor on their order.
"""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from templates import euclidean, spherical
from templates.blas import single_threaded
from templates.crossgram import Indices
from templates.distances import Metric
from templates.kernels.euclidean import euclidean_subspaces
from templates.kernels.euclidean import scratch_size as euclidean_scratch
from templates.kernels.lanes import LANES
from templates.kernels.points import euclidean_points, spherical_points
from templates.kernels.spherical import scratch_size as spherical_scratch
from templates.kernels.spherical import spherical_subspaces
from templates.subspace import SubspaceBatch

Floats = NDArray[np.float32]
Probes = Floats | SubspaceBatch
Progress = Callable[[int], None]
"""Called with a number of pairs that are done."""

_NEAR = np.float32(0.1)
_ACCURACY = np.float32(5e-5)
# Rows of the product of a tile, either way: 4 MiB.
_TILE_SIDE = 1024
_BLOCK_BYTES = 32 << 20
_PAIRED_BYTES = 8 << 20
_TASKS = 16
# Multiplications, about half a millisecond's, below which another thread does not pay.
_LEAST = 1 << 25
_MOST_SPARE = 16
_SPARE_BYTES = 16 << 20
_SHORT = np.float32(1e-12)
_TINY = np.float32(np.finfo(np.float32).tiny)

_Place = tuple[slice, Floats | None]
"""A part of the probes, and room for its stacked rows where they are stacked."""

_In = TypeVar("_In")
_Out = TypeVar("_Out")


class Collector(Protocol):
    """Where one thread puts its tiles."""

    def take(self, rows: slice, columns: slice, distances: Floats) -> None:
        """Use a tile (R · C,); C is the number of columns rounded up to 16."""
        ...


_Kept = TypeVar("_Kept", bound=Collector)


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
    """Compute every distance once and hand it to a collector.

    Parameters
    ----------
    probes : (P, n) float32, or SubspaceBatch of P
    templates : SubspaceBatch of T
    collector
        Called once in every thread. Which tiles a thread gets varies from run to run.
    threads
        At most; by default as many as the matrix library has.
    """
    solver = _Solver(probes, templates, metric, steps)
    collectors: list[_Kept] = []

    def keep(rows: _Tile, columns: _Tile, space: _Space) -> None:
        if space.collector is None:
            space.collector = collector()
            collectors.append(space.collector)
        wide = whole(len(columns))
        distances = space.distances[: len(rows) * wide]
        solver.solve(rows, columns, space, distances.reshape(len(rows), wide))
        space.collector.take(rows.part, columns.part, distances)

    _each_tile(solver, keep, threads, progress)
    return collectors


def fill(
    probes: Probes,
    templates: SubspaceBatch,
    out: Floats,
    *,
    metric: Metric,
    steps: int,
    threads: int | None = None,
) -> None:
    """Write all distances to ``out``, (P, T), C-contiguous."""
    solver = _Solver(probes, templates, metric, steps)

    def write(rows: _Tile, columns: _Tile, space: _Space) -> None:
        solver.solve(rows, columns, space, out[rows.part, columns.part])

    _each_tile(solver, write, threads, None)


def _each_tile(
    solver: "_Solver",
    act: Callable[["_Tile", "_Tile", "_Space"], None],
    threads: int | None,
    progress: Progress | None,
) -> None:
    tasks = solver.tasks()
    if not tasks:
        return
    lock = threading.Lock()
    most = min(len(tasks), max(1, solver.multiplications // _LEAST))
    with single_threaded() as available, _Crew(min(threads or available, most)) as crew:
        spaces = [solver.space() for _ in range(crew.count)]
        for block in solver.row_blocks():
            tiles = crew.map(solver.pack_probes, block)

            def one(task: _Task, tiles: list[_Tile] = tiles) -> None:
                space = spaces.pop()
                columns = solver.pack_templates(task.columns, space)
                for rows in tiles[task.share :: task.shares]:
                    act(rows, columns, space)
                    if progress is not None:
                        with lock:
                            progress(len(rows) * len(columns))
                spaces.append(space)

            crew.map(one, tasks)
        for space in spaces:
            space.clear()
            _spare.put(space.memory)


@dataclass(frozen=True, eq=False, repr=False)
class _Tile:
    """Stacked rows of some probes or templates."""

    part: slice
    stacked: Floats
    """(R, m + 1, n) of probes, (m + 1, C, n) of templates; (R, n) of points."""
    numbers: Floats
    """One for each: squared lengths of feet or points, or what the kernel asks for."""

    def __len__(self) -> int:
        return int(self.part.stop - self.part.start)


class _Task(NamedTuple):
    """Some templates, and a share of the probes' tiles."""

    columns: slice
    share: int
    shares: int


class _Space:
    """Working space of one thread, and its collector.

    Fresh memory costs more than a small tile: it comes page by page. So a finished traversal leaves
    its spaces to the next.
    """

    def __init__(self, product: int, stacked: int, distances: int, work: int) -> None:
        sizes = product, stacked, distances, work
        self.memory = _spare.get(sum(sizes))
        ends = np.cumsum(sizes)
        self.product, self.stacked, self.distances, self.work = (
            self.memory[end - size : end] for end, size in zip(ends, sizes, strict=True)
        )
        self.work[:] = 0
        self.collector: Any = None
        self._used = sum(sizes)

    def clear(self) -> None:
        """Forget: what is kept for the next traversal holds nothing of this one."""
        self.memory[: self._used] = 0


class _Spare:
    """A few arrays for the next traversal."""

    def __init__(self) -> None:
        self._arrays: list[Floats] = []

    def get(self, size: int) -> Floats:
        try:
            found = self._arrays.pop()
        except IndexError:
            return np.empty(size, dtype=np.float32)
        return found if len(found) >= size else np.empty(size, dtype=np.float32)

    def put(self, array: Floats) -> None:
        if len(self._arrays) < _MOST_SPARE and array.nbytes <= _SPARE_BYTES:
            self._arrays.append(array)


_spare = _Spare()


class _Crew:
    """The calling thread and others, which share the items of a list."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._others = count - 1
        self._pool = ThreadPoolExecutor(self._others) if self._others else None

    def __enter__(self) -> "_Crew":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def map(self, function: Callable[[_In], _Out], items: Sequence[_In]) -> list[_Out]:
        """Return the results in order; the first failure ends the work and is raised."""
        waiting = iter(list(enumerate(items)))
        lock = threading.Lock()
        results: dict[int, _Out] = {}
        failures: list[BaseException] = []

        def work() -> None:
            while not failures:
                with lock:
                    number, item = next(waiting, (None, None))
                if number is None:
                    return
                try:
                    results[number] = function(item)  # type: ignore[arg-type]
                except BaseException as failure:
                    failures.append(failure)

        others = []
        if self._pool is not None:
            others = [self._pool.submit(work) for _ in range(min(self._others, len(items) - 1))]
        # The calling thread works too: it holds a core already, and leaves the others the rest.
        work()
        for other in others:
            other.result()
        if failures:
            raise failures[0]
        return [results[number] for number in range(len(items))]


class _Solver:
    """One problem: its tiles, and a tile's distances."""

    def __init__(
        self, probes: Probes, templates: SubspaceBatch, metric: Metric, steps: int
    ) -> None:
        self._probes, self._templates = probes, templates
        self._euclidean, self._steps = metric is Metric.EUCLIDEAN, steps
        self._m = probes.m if isinstance(probes, SubspaceBatch) else 0
        width = LANES * max(1, _TILE_SIDE // ((templates.m + 1) * LANES))
        self._rows = _even(len(probes), max(1, _TILE_SIDE // (self._m + 1)))
        self._columns = whole(_even(len(templates), width))

    @property
    def multiplications(self) -> int:
        """Of the product of all rows."""
        each = (self._m + 1) * (self._templates.m + 1) * self._templates.n
        return len(self._probes) * len(self._templates) * each

    def tasks(self) -> list[_Task]:
        """Parts of equal work, enough of them for several threads; they do not show."""
        columns = _parts(len(self._templates), self._columns)
        tiles = len(_parts(len(self._probes), self._rows))
        shares = min(tiles, -(-_TASKS // max(1, len(columns))))
        return [_Task(some, share, shares) for some in columns for share in range(shares)]

    def row_blocks(self) -> Iterator[list[_Place]]:
        """Parts of the probes, and room for their stacked rows, block by block."""
        parts = _parts(len(self._probes), self._rows)
        if not self._m:
            yield [(part, None) for part in parts]
            return
        numbers = self._rows * (self._m + 1) * self._templates.n
        several = min(len(parts), max(1, _BLOCK_BYTES // (4 * numbers)))
        room = np.empty((several, numbers), dtype=np.float32)
        for first in range(0, len(parts), several):
            yield list(zip(parts[first : first + several], room, strict=False))

    def space(self) -> _Space:
        """Make what a thread needs for the largest tile."""
        m_d, m_e = self._m, self._templates.m
        pairs = self._rows * self._columns
        size = 0
        if m_d:
            size = (euclidean_scratch if self._euclidean else spherical_scratch)(m_d, m_e)
        stacked = self._columns * (m_e + 1) * self._templates.n
        return _Space(pairs * (m_d + 1) * (m_e + 1), stacked, pairs, size)

    def pack_probes(self, place: _Place) -> _Tile:
        """Stack the rows of some probes, probe after probe."""
        part, room = place
        if not isinstance(self._probes, SubspaceBatch):
            points = self._probes[part]
            squares = _squares(points)
            if self._euclidean:
                return _Tile(part, points, squares)
            # Squares of very short and very long points do not fit float32.
            odd = np.flatnonzero((squares < _SHORT) | (squares > 1 / _SHORT))
            if odd.size:
                points = points.copy()
                points[odd] = spherical.directions(points[odd])
                squares = _squares(points)
            lengths = np.sqrt(np.maximum(squares, _TINY))
            return _Tile(part, points, np.reciprocal(lengths))
        some = self._probes[part]
        shape = len(some), some.m + 1, some.n
        stacked = np.empty(shape, np.float32) if room is None else _shaped(room, shape)
        self._stack(some, stacked[:, 0], stacked[:, 1:])
        return _Tile(part, stacked, _squares(some.feet))

    def pack_templates(self, part: slice, space: _Space | None) -> _Tile:
        """Stack the rows of some templates, all feet first; the number is filled up with zeros."""
        some = self._templates[part]
        shape = some.m + 1, whole(len(some)), some.n
        stacked = np.empty(shape, np.float32) if space is None else _shaped(space.stacked, shape)
        stacked[:, len(some) :] = 0
        own = stacked[:, : len(some)]
        squares = np.zeros(shape[1], dtype=np.float32)
        squares[: len(some)] = _squares(some.feet)
        self._stack(some, own[0], own[1:].transpose(1, 0, 2))
        return _Tile(part, stacked, squares)

    def _stack(self, batch: SubspaceBatch, feet: Floats, bases: Floats) -> None:
        if self._euclidean:
            feet[:], bases[:] = batch.feet, batch.bases
            return
        scales, radii = spherical.spheres(batch)
        np.multiply(batch.feet, scales.astype(np.float32)[:, None], out=feet)
        np.multiply(batch.bases, radii.astype(np.float32)[:, None, None], out=bases)

    def solve(self, rows: _Tile, columns: _Tile, space: _Space, out: Floats) -> None:
        """Write the distances of a tile to ``out``, (R, T or more), a part of an array's rows."""
        n = self._templates.n
        left, right = rows.stacked.reshape(-1, n), columns.stacked.reshape(-1, n)
        product = space.product[: len(left) * len(right)]
        with np.errstate(over="ignore", invalid="ignore"):  # such pairs are computed again
            np.matmul(left, right.T, out=product.reshape(len(left), len(right)))
        if self._solve(product, rows.numbers, columns.numbers, space.work, out):
            table = out[:, : len(columns)]
            i, j = np.nonzero(table < 0)
            table[i, j] = self._exact(i + rows.part.start, j + columns.part.start)

    def paired(self, part: slice) -> Floats:
        """Distances of probes to the templates of the same positions."""
        mine, theirs = self.pack_probes((part, None)), self.pack_templates(part, None)
        count, wide = len(mine), theirs.stacked.shape[1]
        m_d, m_e = self._m, self._templates.m
        product = np.zeros((m_d + 1, m_e + 1, wide), dtype=np.float32)
        columns = theirs.stacked[:, :count].transpose(1, 2, 0)
        with np.errstate(over="ignore", invalid="ignore"):  # such pairs are computed again
            product[:, :, :count] = (mine.stacked @ columns).transpose(1, 2, 0)
        squares = theirs.numbers
        squares[:count] += mine.numbers
        size = (euclidean_scratch if self._euclidean else spherical_scratch)(m_d, m_e)
        work, out = np.zeros(size, dtype=np.float32), np.empty(wide, dtype=np.float32)
        nothing = np.zeros(1, dtype=np.float32)
        if self._solve(product.reshape(-1), nothing, squares, work, out[None]):
            again = np.flatnonzero(out[:count] < 0)
            out[again] = self._exact(again + part.start, again + part.start)
        return out[:count]

    def _solve(
        self, product: Floats, mine: Floats, theirs: Floats, work: Floats, out: Floats
    ) -> int:
        m_d, m_e = self._m, self._templates.m
        rows, columns = len(mine), len(theirs)
        # The kernels write to the memory behind a view, row by row.
        stride, count = out.strides[0] // out.itemsize, min(out.shape[1], columns)
        flat = np.lib.stride_tricks.as_strided(out, ((rows - 1) * stride + count,), (out.itemsize,))
        place = flat, stride, count
        if not m_d:
            if self._euclidean:
                return euclidean_points(product, mine, theirs, m_e, _NEAR, *place)
            return spherical_points(product, mine, columns, m_e, _NEAR, *place)
        if self._euclidean:
            return euclidean_subspaces(
                product, mine, theirs, m_d, m_e, _NEAR, _ACCURACY, work, flat, stride, count
            )
        return spherical_subspaces(
            product, rows, columns, m_d, m_e, self._steps, _NEAR, work, *place
        )

    def _exact(self, i: Indices, j: Indices) -> NDArray[np.float64]:
        probes, templates = self._probes, self._templates
        if not isinstance(probes, SubspaceBatch):
            exact = euclidean.points_exact if self._euclidean else spherical.points_exact
            return exact(probes, templates, i, j)
        if self._euclidean:
            return euclidean.subspaces_exact(probes, templates, i, j)
        return spherical.subspaces_exact(probes, templates, i, j, self._steps)


def _squares(rows: Floats) -> Floats:
    squares = np.einsum("ij,ij->i", rows, rows, dtype=np.float64)
    return np.asarray(np.minimum(squares, np.finfo(np.float32).max), dtype=np.float32)


def whole(count: int) -> int:
    """Round up to whole vectors."""
    return count + -count % LANES


def _even(count: int, most: int) -> int:
    """Size of the parts of ``count`` that are equal, at most ``most``, and even in number."""
    parts = -(-count // most)
    return -(-count // (parts + parts % 2 if parts > 1 else 1))


def _parts(count: int, step: int) -> list[slice]:
    return [slice(start, min(start + step, count)) for start in range(0, count, step or 1)]


def _shaped(room: Floats, shape: tuple[int, ...]) -> Floats:
    return room[: math.prod(shape)].reshape(shape)


def paired_tile(
    probes: SubspaceBatch, templates: SubspaceBatch, *, metric: Metric, steps: int
) -> Floats:
    """Distances of probe i to template i, (P,)."""
    out = np.empty(len(probes), dtype=np.float32)
    solver = _Solver(probes, templates, metric, steps)
    numbers = (probes.m + templates.m + 2) * probes.n + (probes.m + 1) * (templates.m + 1)
    step = max(1, _PAIRED_BYTES // (4 * numbers))
    with single_threaded():
        for start in range(0, len(probes), step):
            part = slice(start, min(start + step, len(probes)))
            out[part] = solver.paired(part)
    return out
