"""Tiles of distances from stacked rows, many in one call: packing, product and kernel.

A thread computes its tiles without the interpreter's lock. Waiting for the lock, even shortly, may
move a thread to the processor of the one that it waited for, and there both stay for milliseconds.
The product is the matrix library's of SciPy, as of all compiled code.
"""

from typing import NamedTuple

import numpy as np

from templates.distances.kernels.arguments import Array32, Integers, Options, Result, Tile
from templates.distances.kernels.euclidean import euclidean_subspaces
from templates.distances.kernels.lanes import LANES, compiled, inlined, take
from templates.distances.kernels.points import points
from templates.distances.kernels.spherical import spherical_subspaces

_MOST = np.float32(np.finfo(np.float32).max)
# Tiles between two chances to stop.
_AT_ONCE = 64


class Grid(NamedTuple):
    """Tiles of ``rows`` probes and ``columns`` templates, counted down the columns first."""

    probes: int
    templates: int
    rows: int
    columns: int

    @property
    def down(self) -> int:
        """Number of tiles of the same templates."""
        return -(-self.probes // self.rows)

    @property
    def tiles(self) -> int:
        """Number of all tiles."""
        return self.down * -(-self.templates // self.columns)

    def tile(self, number: int) -> tuple[slice, slice]:
        """Probes and templates of a tile."""
        row, column = number % self.down * self.rows, number // self.down * self.columns
        return (
            slice(row, min(row + self.rows, self.probes)),
            slice(column, min(column + self.columns, self.templates)),
        )


class Sides(NamedTuple):
    """Probes and templates of a problem."""

    stacked: Array32
    """Points (P, n), or the rows of lifted probes, probe after probe, (P · (m_d + 1), n)."""
    probe_terms: Array32
    """(P,), as of a tile."""
    m_d: int
    feet: Array32
    bases: Array32


class Space(NamedTuple):
    """Working space of a thread, for the largest tile."""

    packed: Array32
    squares: Array32
    product: Array32
    work: Array32
    first: Integers
    """(1,): the first of the templates that are packed, or −1."""


@inlined
def _square(row: Array32) -> float:
    """Squared length; several sums, because a processor adds several numbers at once."""
    n = len(row)
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for x in range(0, n - 3, 4):
        a, b = np.float64(row[x]), np.float64(row[x + 1])
        c, d = np.float64(row[x + 2]), np.float64(row[x + 3])
        s0 += a * a
        s1 += b * b
        s2 += c * c
        s3 += d * d
    for x in range(n - n % 4, n):
        a = np.float64(row[x])
        s0 += a * a
    return (s0 + s1) + (s2 + s3)


@compiled
def square(rows: Array32, out: Array32) -> None:
    """Write the squared lengths of rows, at most the largest float32 number."""
    for i in range(len(rows)):
        out[i] = np.float32(min(_square(rows[i]), np.float64(_MOST)))


@compiled
def pack(
    feet: Array32, bases: Array32, first: int, count: int, spherical: bool, space: Space, wide: int
) -> None:
    """Stack the rows of some templates, all feet first, (m + 1, wide, n), with zeros behind them.

    The spherical metric scales the foot to the unit ball, and the rows by the radius of the
    sphere's section. The squared lengths of the feet are written too.
    """
    m, n = bases.shape[1], bases.shape[2]
    packed, squares = space.packed, space.squares
    for c in range(wide):
        if c >= count:
            squares[c] = 0
            for k in range(m + 1):
                packed[(k * wide + c) * n : (k * wide + c + 1) * n] = 0
            continue
        foot = feet[first + c]
        square = _square(foot)
        squares[c] = np.float32(min(square, np.float64(_MOST)))
        scale = radius = np.float32(1)
        if spherical:
            length = np.sqrt(square)
            scale = np.float32(1 / max(length, 1.0))
            radius = np.float32(np.sqrt(max(1 - length * length, 0.0)))
        place = c * n
        for x in range(n):
            packed[place + x] = foot[x] * scale
        for k in range(m):
            row = bases[first + c, k]
            place = ((k + 1) * wide + c) * n
            for x in range(n):
                packed[place + x] = row[x] * radius


@compiled
def solve(tile: Tile, options: Options, work: Array32, out: Result) -> int:
    """Write the distances of a tile; return the number of −1, or of groups with one."""
    if tile.m_d == 0:
        return points(tile, options, out)
    if options.spherical:
        return spherical_subspaces(tile, options, work, out)
    return euclidean_subspaces(tile, options, work, out)


@compiled
def compute(
    sides: Sides,
    grid: Grid,
    options: Options,
    space: Space,
    counter: Integers,
    out: Array32,
    stride: int,
    inexact: Integers,
) -> int:
    """Compute the next tiles; return the number of the last of them, or −1 where none is left.

    Parameters
    ----------
    counter
        (1,) int64, the number of the next tile; threads that share it share the tiles.
    out : flat float32
        All distances, ``stride`` a row; or, where ``stride`` is 0, those of one tile.
    inexact : int64
        For each tile, what :func:`solve` returns.
    """
    m_d, m_e, n = sides.m_d, sides.bases.shape[1], sides.feet.shape[1]
    down = -(-grid.probes // grid.rows)
    tiles = down * -(-grid.templates // grid.columns)
    number = -1
    for _ in range(_AT_ONCE if stride else 1):
        number = take(counter)
        if number >= tiles:
            return -1
        row = number % down * grid.rows
        end = min(row + grid.rows, grid.probes)
        first = number // down * grid.columns
        count = min(grid.columns, grid.templates - first)
        wide = count + -count % LANES
        if space.first[0] != first:
            pack(sides.feet, sides.bases, first, count, options.spherical, space, wide)
            space.first[0] = first
        rows, columns = (end - row) * (m_d + 1), wide * (m_e + 1)
        product = space.product[: rows * columns]
        np.dot(
            sides.stacked[row * (m_d + 1) : end * (m_d + 1)],
            space.packed[: columns * n].reshape(columns, n).T,
            product.reshape(rows, columns),
        )
        tile = Tile(product, sides.probe_terms[row:end], space.squares[:wide], m_d, m_e)
        if stride:
            result = Result(out[row * stride + first :], stride, count)
        else:
            result = Result(out, wide, wide)
        inexact[number] = solve(tile, options, space.work, result)
    return number
