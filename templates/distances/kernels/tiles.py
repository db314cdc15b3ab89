"""Tiles of distances from stacked rows, many in one call: packing, product and kernel.

A thread computes its tiles without the interpreter's lock. Waiting for the lock, even shortly, may
move a thread to the processor of the one that it waited for, and there both stay for milliseconds.
The product is the matrix library's of SciPy, as of all compiled code.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from templates.distances.kernels.euclidean import euclidean_subspaces
from templates.distances.kernels.lanes import LANES, compiled, inlined, take
from templates.distances.kernels.points import euclidean_points, spherical_points
from templates.distances.kernels.spherical import spherical_subspaces

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]

_MOST = np.float32(np.finfo(np.float32).max)


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


@inlined
def _square(row: Floats) -> float:
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
def square(rows: Floats, out: Floats) -> None:
    """Write the squared lengths of rows, at most the largest float32 number."""
    for i in range(len(rows)):
        out[i] = np.float32(min(_square(rows[i]), np.float64(_MOST)))


@compiled
def pack(
    feet: Floats,
    bases: Floats,
    first: int,
    count: int,
    spherical: bool,
    stacked: Floats,
    squares: Floats,
) -> None:
    """Stack the rows of some templates, all feet first.

    Parameters
    ----------
    feet, bases : (T, n) and (T, m, n)
    first, count
        The templates.
    spherical
        Scale the foot to the unit ball, and the rows by the radius of the sphere's section.
    stacked : flat float32
        (m + 1, C, n), C being the length of ``squares``; what is behind the templates is zeros.
    squares : (C,)
        Squared lengths of the feet.
    """
    m, n = bases.shape[1], bases.shape[2]
    wide = len(squares)
    for c in range(wide):
        if c >= count:
            squares[c] = 0
            for k in range(m + 1):
                stacked[(k * wide + c) * n : (k * wide + c + 1) * n] = 0
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
            stacked[place + x] = foot[x] * scale
        for k in range(m):
            row = bases[first + c, k]
            place = ((k + 1) * wide + c) * n
            for x in range(n):
                stacked[place + x] = row[x] * radius


@inlined
def _multiply(
    left: Floats,
    feet: Floats,
    bases: Floats,
    grid: Grid,
    number: int,
    held: Integers,
    spherical: bool,
    m_d: int,
    stacked: Floats,
    squares: Floats,
    product: Floats,
) -> tuple[int, int, int, int, int]:
    """Make the products of a tile; return its first row and end, its first column, number, width.

    ``held`` has the number of the first template that is packed, or −1.
    """
    n = feet.shape[1]
    down = -(-grid.probes // grid.rows)
    row = number % down * grid.rows
    end = min(row + grid.rows, grid.probes)
    first = number // down * grid.columns
    count = min(grid.columns, grid.templates - first)
    wide = count + -count % LANES
    if held[0] != first:
        pack(feet, bases, first, count, spherical, stacked, squares[:wide])
        held[0] = first
    rows, columns = (end - row) * (m_d + 1), wide * (bases.shape[1] + 1)
    right = stacked[: columns * n].reshape(columns, n)
    np.dot(
        left[row * (m_d + 1) : end * (m_d + 1)],
        right.T,
        product[: rows * columns].reshape(rows, columns),
    )
    return row, end, first, count, wide


@inlined
def _place(
    out: Floats, stride: int, row: int, first: int, count: int, wide: int
) -> tuple[Floats, int, int]:
    """Return where a tile's distances go, the length of a row there, and how many of it to write.

    In the matrix of all distances, or, where ``stride`` is 0, in working space for this tile.
    """
    if stride:
        return out[row * stride + first :], stride, count
    return out, wide, wide


@compiled
def point_tiles(
    left: Floats,
    mine: Floats,
    feet: Floats,
    bases: Floats,
    grid: Grid,
    counter: Integers,
    last: int,
    most: int,
    held: Integers,
    spherical: bool,
    least: np.float32,
    stacked: Floats,
    squares: Floats,
    product: Floats,
    out: Floats,
    stride: int,
    found: Integers,
) -> None:
    """Compute tiles of distances of points to templates.

    Parameters
    ----------
    left, mine : (P, n) and (P,)
        Points, and what the kernel asks for.
    feet, bases
        Of all templates.
    counter : (1,) int64
        Number of the next tile; threads that share it share the tiles.
    last, most
        Return when the counter has reached the last, or after so many tiles.
    held : (1,) int64
        First of the templates that are packed in ``stacked``, or −1.
    spherical, least
        The metric; the smallest distance that is not −1 in ``out``.
    stacked, squares, product
        Working space, for the largest tile.
    out : flat float32
        All distances, ``stride`` a row; or those of one tile where ``stride`` is 0.
    found : int64
        For each tile, what the kernel returns.
    """
    m = bases.shape[1]
    for _ in range(most):
        number = take(counter)
        if number >= last:
            return
        row, end, first, count, wide = _multiply(
            left, feet, bases, grid, number, held, spherical, 0, stacked, squares, product
        )
        place, step, width = _place(out, stride, row, first, count, wide)
        if spherical:
            found[number] = spherical_points(
                product, mine[row:end], wide, m, least, place, step, width
            )
        else:
            found[number] = euclidean_points(
                product, mine[row:end], squares[:wide], m, least, place, step, width
            )


@compiled
def euclidean_tiles(
    left: Floats,
    mine: Floats,
    feet: Floats,
    bases: Floats,
    grid: Grid,
    counter: Integers,
    last: int,
    most: int,
    held: Integers,
    m_d: int,
    least: np.float32,
    accuracy: np.float32,
    work: Floats,
    stacked: Floats,
    squares: Floats,
    product: Floats,
    out: Floats,
    stride: int,
    found: Integers,
) -> None:
    """Compute Euclidean distances of lifted probes, whose m_d + 1 rows follow each other.

    Parameters are those of :func:`point_tiles` and of the kernel.
    """
    m = bases.shape[1]
    for _ in range(most):
        number = take(counter)
        if number >= last:
            return
        row, end, first, count, wide = _multiply(
            left, feet, bases, grid, number, held, False, m_d, stacked, squares, product
        )
        place, step, width = _place(out, stride, row, first, count, wide)
        found[number] = euclidean_subspaces(
            product,
            mine[row:end],
            squares[:wide],
            m_d,
            m,
            least,
            accuracy,
            work,
            place,
            step,
            width,
        )


@compiled
def spherical_tiles(
    left: Floats,
    feet: Floats,
    bases: Floats,
    grid: Grid,
    counter: Integers,
    last: int,
    most: int,
    held: Integers,
    m_d: int,
    steps: int,
    least: np.float32,
    work: Floats,
    stacked: Floats,
    squares: Floats,
    product: Floats,
    out: Floats,
    stride: int,
    found: Integers,
) -> None:
    """Compute spherical distances of lifted probes, whose m_d + 1 rows follow each other.

    Parameters are those of :func:`point_tiles` and of the kernel.
    """
    m = bases.shape[1]
    for _ in range(most):
        number = take(counter)
        if number >= last:
            return
        row, end, first, count, wide = _multiply(
            left, feet, bases, grid, number, held, True, m_d, stacked, squares, product
        )
        place, step, width = _place(out, stride, row, first, count, wide)
        found[number] = spherical_subspaces(
            product, end - row, wide, m_d, m, steps, least, work, place, step, width
        )
