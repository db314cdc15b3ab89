"""Distances of all probes to all templates, a tile at a time, on compiled kernels and all cores.

One tile is the product of the stacked rows [p; D] of some probes and some templates (docs/method.md
§5), made by the matrix library and solved by a kernel while it is in the cache. Memory is bounded
by the tiles of the threads.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from templates.distances import euclidean, spherical
from templates.distances.blas import single_threaded
from templates.distances.crew import Crew
from templates.distances.crossgram import Indices
from templates.distances.kernels.euclidean import euclidean_subspaces
from templates.distances.kernels.euclidean import scratch_size as euclidean_scratch
from templates.distances.kernels.lanes import LANES
from templates.distances.kernels.spherical import scratch_size as spherical_scratch
from templates.distances.kernels.spherical import spherical_subspaces
from templates.distances.kernels.tiles import (
    Grid,
    euclidean_tiles,
    pack,
    point_tiles,
    spherical_tiles,
    square,
)
from templates.distances.metric import Metric
from templates.space.subspace import SubspaceBatch

Floats = NDArray[np.float32]
Probes = Floats | SubspaceBatch
Progress = Callable[[int], None]
"""Called with a number of pairs that are done."""

_NEAR = np.float32(0.1)
_ACCURACY = np.float32(5e-5)
# Rows of the product of a tile; the probes have half: 2 MiB.
_TILE_SIDE = 1024
_FLAT = 2
# Tiles between two chances to stop.
_AT_ONCE = 64
# Numbers that one thread stacks sooner than several.
_SMALL_BLOCK = 1 << 22
_BLOCK_BYTES = 32 << 20
_PAIRED_BYTES = 8 << 20
# Multiplications, about half a millisecond's, below which another thread does not pay.
_LEAST = 1 << 25
_MOST_SPARE = 16
_SPARE_BYTES = 16 << 20
_SHORT = np.float32(1e-12)
_TINY = np.float32(np.finfo(np.float32).tiny)


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
    lock = threading.Lock()

    def work(block: _Block, space: _Space) -> None:
        if space.collector is None:
            space.collector = collector()
            collectors.append(space.collector)
        while (number := block.take()) is not None:
            rows, columns = block.grid.tile(number)
            wide = whole(columns.stop - columns.start)
            distances = space.distances[: (rows.stop - rows.start) * wide]
            solver.compute(block, space, distances, one=number)
            if block.found[number]:
                solver.correct(block, number, distances.reshape(-1, wide))
            part = slice(rows.start + block.first, rows.stop + block.first)
            space.collector.take(part, columns, distances)
            if progress is not None:
                with lock:
                    progress((part.stop - part.start) * (columns.stop - columns.start))

    with _spaces(solver, threads, collecting=True) as (crew, spaces):
        for block in solver.blocks(crew):
            crew.map(partial(_until_done, work, block), spaces)
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
    with _spaces(solver, threads, collecting=False) as (crew, spaces):
        for block in solver.blocks(crew):
            rows = out[block.first : block.first + block.grid.probes]

            def work(block: _Block, space: _Space, rows: Floats = rows) -> None:
                while block.counter[0] < block.grid.tiles:
                    solver.compute(block, space, rows.reshape(-1))

            crew.map(partial(_until_done, work, block), spaces)

            def correct(number: int, block: _Block = block, rows: Floats = rows) -> None:
                solver.correct(block, number, rows[block.grid.tile(number)])

            crew.map(correct, np.flatnonzero(block.found).tolist())


@contextmanager
def _spaces(
    solver: "_Solver", threads: int | None, *, collecting: bool
) -> Iterator[tuple[Crew, list["_Space"]]]:
    """Threads for a problem, and a working space for each."""
    most = max(1, min(solver.tiles, solver.multiplications // _LEAST))
    with single_threaded() as available, Crew(min(threads or available, most)) as crew:
        spaces = [solver.space(collecting=collecting) for _ in range(crew.count)]
        yield crew, spaces
        for space in spaces:
            space.clear()
            _spare.put(space.memory)


def _until_done(
    work: Callable[["_Block", "_Space"], None], block: "_Block", space: "_Space"
) -> None:
    try:
        work(block, space)
    except BaseException:
        block.end()
        raise


class _Block:
    """Stacked rows of some probes, and the tiles that they have with all templates."""

    def __init__(self, first: int, stacked: Floats, numbers: Floats, grid: Grid) -> None:
        self.first, self.grid = first, grid
        self.stacked = _locked(stacked)
        self.numbers = numbers
        """One for each: squared lengths of feet or points, or what the kernel asks for."""
        self.counter = np.zeros(1, dtype=np.int64)
        self.found = np.zeros(grid.tiles, dtype=np.int64)
        self._lock = threading.Lock()

    def take(self) -> int | None:
        """Return the number of the next tile."""
        with self._lock:
            number = int(self.counter[0])
            self.counter[0] = number + 1
        return number if number < self.grid.tiles else None

    def end(self) -> None:
        """Leave the other tiles."""
        self.counter[0] = self.grid.tiles


class _Space:
    """Working space of one thread, and its collector.

    Fresh memory costs more than a small tile: it comes page by page. So a finished traversal leaves
    its spaces to the next.
    """

    def __init__(self, product: int, stacked: int, squares: int, distances: int, work: int) -> None:
        sizes = product, stacked, squares, distances, work
        self.memory = _spare.get(sum(sizes))
        ends = np.cumsum(sizes)
        self.product, self.stacked, self.squares, self.distances, self.work = (
            self.memory[end - size : end] for end, size in zip(ends, sizes, strict=True)
        )
        self.work[:] = 0
        self.held = np.full(1, -1, dtype=np.int64)
        """First of the templates that are packed."""
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


class _Solver:
    """One problem: its tiles, and a tile's distances."""

    def __init__(
        self, probes: Probes, templates: SubspaceBatch, metric: Metric, steps: int
    ) -> None:
        self._probes, self._templates = probes, templates
        self._euclidean, self._steps = metric is Metric.EUCLIDEAN, steps
        self._m = probes.m if isinstance(probes, SubspaceBatch) else 0
        width = LANES * max(1, _TILE_SIDE // ((templates.m + 1) * LANES))
        self._rows = _even(len(probes), max(1, _TILE_SIDE // _FLAT // (self._m + 1)))
        self._columns = whole(_even(len(templates), width))

    @property
    def multiplications(self) -> int:
        """Of the product of all rows."""
        each = (self._m + 1) * (self._templates.m + 1) * self._templates.n
        return len(self._probes) * len(self._templates) * each

    @property
    def tiles(self) -> int:
        """Number of all tiles, at least."""
        return self._grid(len(self._probes)).tiles

    def _grid(self, probes: int) -> Grid:
        return Grid(probes, len(self._templates), max(1, self._rows), max(1, self._columns))

    def blocks(self, crew: Crew) -> Iterator[_Block]:
        """Stack the rows of the probes, block by block in the same room."""
        if not self._columns:
            return
        numbers = max(1, self._rows) * (self._m + 1) * self._templates.n
        step = self._rows * max(1, _BLOCK_BYTES // (4 * numbers))
        room = None
        for part in _parts(len(self._probes), step):
            if isinstance(self._probes, SubspaceBatch):
                count = part.stop - part.start
                if room is None:
                    room = np.empty((count, self._m + 1, self._templates.n), dtype=np.float32)
                stacked, kept = self._stack_probes(part, room[:count], crew)
            else:
                stacked, kept = self._take_points(self._probes[part])
            rows = stacked.reshape(-1, self._templates.n)
            yield _Block(part.start, rows, kept, self._grid(len(stacked)))

    def space(self, *, collecting: bool) -> _Space:
        """Make what a thread needs for the largest tile."""
        m_d, m_e = self._m, self._templates.m
        pairs = self._rows * self._columns
        size = 0
        if m_d:
            size = (euclidean_scratch if self._euclidean else spherical_scratch)(m_d, m_e)
        stacked = self._columns * (m_e + 1) * self._templates.n
        product = pairs * (m_d + 1) * (m_e + 1)
        return _Space(product, stacked, self._columns, pairs if collecting else 0, size)

    def _take_points(self, points: Floats) -> tuple[Floats, Floats]:
        squares = _squares(points)
        if self._euclidean:
            return points, squares
        # Squares of very short and very long points do not fit float32.
        odd = np.flatnonzero((squares < _SHORT) | (squares > 1 / _SHORT))
        if odd.size:
            points = points.copy()
            points[odd] = spherical.directions(points[odd])
            squares = _squares(points)
        return points, np.reciprocal(np.sqrt(np.maximum(squares, _TINY)))

    def _stack_probes(self, part: slice, room: Floats, crew: Crew) -> tuple[Floats, Floats]:
        """Stack the rows of lifted probes, probe after probe."""
        probes = self._probes[part]
        assert isinstance(probes, SubspaceBatch)  # noqa: S101
        squares = np.empty(len(probes), dtype=np.float32)

        def one(some: slice) -> None:
            self._stack(probes[some], room[some, 0], room[some, 1:])
            squares[some] = _squares(probes.feet[some])

        step = len(probes) if room.size < _SMALL_BLOCK else self._rows
        crew.map(one, _parts(len(probes), step))
        return room, squares

    def _stack(self, batch: SubspaceBatch, feet: Floats, bases: Floats) -> None:
        if self._euclidean:
            feet[:], bases[:] = batch.feet, batch.bases
            return
        scales, radii = spherical.spheres(batch)
        np.multiply(batch.feet, scales.astype(np.float32)[:, None], out=feet)
        np.multiply(batch.bases, radii.astype(np.float32)[:, None, None], out=bases)

    def compute(self, block: _Block, space: _Space, out: Floats, *, one: int | None = None) -> None:
        """Write the distances of some of the next tiles to ``out``; −1 where they are not exact.

        Parameters
        ----------
        out
            All of the block, flat; or those of the tile ``one``.
        """
        batch, m_d = self._templates, self._m
        counter = block.counter if one is None else np.array([one], dtype=np.int64)
        last, stride = (block.grid.tiles, len(batch)) if one is None else (one + 1, 0)
        task = batch.feet, batch.bases, block.grid, counter, last, _AT_ONCE, space.held
        room = space.stacked, space.squares, space.product
        ends = out, stride, block.found
        if not m_d:
            point_tiles(
                block.stacked, block.numbers, *task, not self._euclidean, _NEAR, *room, *ends
            )
        elif self._euclidean:
            euclidean_tiles(
                block.stacked, block.numbers, *task, m_d, _NEAR, _ACCURACY, space.work, *room, *ends
            )
        else:
            spherical_tiles(block.stacked, *task, m_d, self._steps, _NEAR, space.work, *room, *ends)

    def correct(self, block: _Block, number: int, out: Floats) -> None:
        """Compute the pairs of a tile exactly that are −1 in ``out``, (R, T or more)."""
        rows, columns = block.grid.tile(number)
        table = out[:, : columns.stop - columns.start]
        i, j = np.nonzero(table < 0)
        if i.size:
            table[i, j] = self._exact(i + rows.start + block.first, j + columns.start)

    def paired(self, part: slice) -> Floats:
        """Distances of probes to the templates of the same positions."""
        probes, batch = self._probes[part], self._templates
        assert isinstance(probes, SubspaceBatch)  # noqa: S101
        count, m_d, m_e, n = len(probes), self._m, batch.m, batch.n
        wide = whole(count)
        mine = np.empty((count, m_d + 1, n), dtype=np.float32)
        self._stack(probes, mine[:, 0], mine[:, 1:])
        theirs = np.empty((m_e + 1, wide, n), dtype=np.float32)
        squares = np.empty(wide, dtype=np.float32)
        spherical = not self._euclidean
        pack(batch.feet, batch.bases, part.start, count, spherical, theirs.reshape(-1), squares)
        squares[:count] += _squares(probes.feet)
        product = np.zeros((m_d + 1, m_e + 1, wide), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # such pairs are computed again
            product[:, :, :count] = (mine @ theirs[:, :count].transpose(1, 2, 0)).transpose(1, 2, 0)
        size = (euclidean_scratch if self._euclidean else spherical_scratch)(m_d, m_e)
        work, out = np.zeros(size, dtype=np.float32), np.empty(wide, dtype=np.float32)
        if self._solve(product.reshape(-1), squares, work, out):
            again = np.flatnonzero(out[:count] < 0)
            out[again] = self._exact(again + part.start, again + part.start)
        return out[:count]

    def _solve(self, product: Floats, squares: Floats, work: Floats, out: Floats) -> int:
        m_d, m_e, wide = self._m, self._templates.m, len(squares)
        if self._euclidean:
            nothing = np.zeros(1, dtype=np.float32)
            return euclidean_subspaces(
                product, nothing, squares, m_d, m_e, _NEAR, _ACCURACY, work, out, wide, wide
            )
        return spherical_subspaces(
            product, 1, wide, m_d, m_e, self._steps, _NEAR, work, out, wide, wide
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
    squares = np.empty(len(rows), dtype=np.float32)
    square(_locked(rows), squares)
    return squares


def _locked(array: Floats) -> Floats:
    """View that cannot be written, as those of a batch: kernels are compiled for one kind."""
    view = array.view()
    view.flags.writeable = False
    return view


def whole(count: int) -> int:
    """Round up to whole vectors."""
    return count + -count % LANES


def _even(count: int, most: int) -> int:
    """Size of the parts of ``count`` that are equal, at most ``most``, and even in number."""
    parts = -(-count // most)
    return -(-count // (parts + parts % 2 if parts > 1 else 1))


def _parts(count: int, step: int) -> list[slice]:
    return [slice(start, min(start + step, count)) for start in range(0, count, step or 1)]


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
