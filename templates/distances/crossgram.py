"""The cross-Gram matrix of probes and templates, a tile at a time (docs/method.md §5).

Every distance starts from the products of the stacked rows [p; D] of one side with those of the
other. They are one matrix product, the floor of the computation on any machine. It is made in
tiles, so memory is bounded by the tile whatever the number of pairs.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from templates.errors import InvalidTemplate, LiftingError
from templates.space.subspace import SubspaceBatch, span_basis

_POINT_TILE_BYTES = 4 << 20  # fits the second-level cache, where the squares are summed
_PAIR_TILE_BYTES = 16 << 20
_GATHER_BYTES = 32 << 20

Floats = NDArray[np.floating[Any]]
Kind = np.dtype[np.floating[Any]]
"""float32 or float64."""
Indices = NDArray[np.int64]


class PointTile(NamedTuple):
    """Products of points ``rows`` and templates ``columns``; arrays are (columns, rows)."""

    rows: slice
    columns: slice
    dots: Floats
    """e·p."""
    spreads: Floats
    """‖D e‖²."""


class PairTile(NamedTuple):
    """Products of K pairs of subspaces, p + span(D) and q + span(E)."""

    first: Indices
    """Index of each pair's probe, shape (K,)."""
    second: Indices
    """Index of each pair's template, shape (K,)."""
    dots: Floats
    """p·q, shape (K,)."""
    left: Floats
    """D q, shape (K, m_D)."""
    right: Floats
    """E p, shape (K, m_E)."""
    middle: Floats
    """D Eᵀ, shape (K, m_D, m_E)."""


def rows_of(batch: SubspaceBatch, dtype: Kind) -> tuple[Floats, Floats]:
    """Feet and bases in ``dtype``; in float64 freed of the rounding of their float32 storage.

    Raises
    ------
    InvalidTemplate
        The basis is nowhere near orthonormal.
    """
    if dtype == np.float32:
        return batch.feet, batch.bases
    try:
        bases = span_basis(batch.bases.astype(np.float64))
    except LiftingError:
        raise InvalidTemplate("a template's basis is linearly dependent") from None
    feet = batch.feet.astype(np.float64)
    feet -= (feet[:, None, :] @ bases.transpose(0, 2, 1) @ bases)[:, 0, :]
    return feet, bases


def point_tiles(points: Floats, templates: SubspaceBatch, dtype: Kind) -> Iterator[PointTile]:
    """Yield the products of all points, shape (P, n), with all templates."""
    wide = min(len(points), 256)
    tall = max(1, _POINT_TILE_BYTES // max(1, wide * templates.m * dtype.itemsize))
    for column in range(0, len(templates), tall):
        columns = slice(column, min(column + tall, len(templates)))
        feet, bases = rows_of(templates[columns], dtype)
        stacked = bases.reshape(-1, templates.n)
        for row in range(0, len(points), wide):
            rows = slice(row, min(row + wide, len(points)))
            some = points[rows].T
            products = (stacked @ some).reshape(len(feet), templates.m, -1)
            np.square(products, out=products)
            yield PointTile(rows, columns, feet @ some, products.sum(axis=1))


def pair_tiles(probes: SubspaceBatch, templates: SubspaceBatch, dtype: Kind) -> Iterator[PairTile]:
    """Yield the products of all probes with all templates, K = (rows × columns) pairs a tile."""
    m_d, m_e, n = probes.m, templates.m, probes.n
    pairs = max(1, _PAIR_TILE_BYTES // ((m_d + 1) * (m_e + 1) * dtype.itemsize))
    tall = max(1, min(len(probes), int(np.sqrt(pairs))))
    wide = max(1, pairs // tall)
    for row in range(0, len(probes), tall):
        rows = np.arange(row, min(row + tall, len(probes)))
        mine = _stacked(probes, rows, dtype)
        for column in range(0, len(templates), wide):
            columns = np.arange(column, min(column + wide, len(templates)))
            theirs = _stacked(templates, columns, dtype)
            products = mine.reshape(-1, n) @ theirs.reshape(-1, n).T
            block = products.reshape(len(rows), m_d + 1, len(columns), m_e + 1)
            block = block.transpose(0, 2, 1, 3)
            count = len(rows) * len(columns)
            yield PairTile(
                np.repeat(rows, len(columns)),
                np.tile(columns, len(rows)),
                block[:, :, 0, 0].reshape(count),
                block[:, :, 1:, 0].reshape(count, m_d),
                block[:, :, 0, 1:].reshape(count, m_e),
                block[:, :, 1:, 1:].reshape(count, m_d, m_e),
            )


def matched_tiles(
    probes: SubspaceBatch, templates: SubspaceBatch, dtype: Kind
) -> Iterator[PairTile]:
    """Yield the products of probe i with template i."""
    step = max(1, _GATHER_BYTES // ((probes.m + templates.m) * probes.n * dtype.itemsize))
    for start in range(0, len(probes), step):
        index = np.arange(start, min(start + step, len(probes)))
        mine = _stacked(probes, index, dtype)
        theirs = _stacked(templates, index, dtype)
        block = mine @ theirs.transpose(0, 2, 1)
        yield PairTile(
            index,
            index,
            block[:, 0, 0],
            block[:, 1:, 0],
            block[:, 0, 1:],
            np.ascontiguousarray(block[:, 1:, 1:]),
        )


def chunks(count: int, numbers_each: int) -> Iterator[slice]:
    """Split ``count`` pairs so that ``numbers_each`` float64 numbers per pair stay bounded."""
    step = max(1, _GATHER_BYTES // (8 * numbers_each))
    return (slice(start, min(start + step, count)) for start in range(0, count, step))


def _stacked(batch: SubspaceBatch, index: Indices, dtype: Kind) -> Floats:
    """Rows [p; D] of some templates, shape (len(index), m + 1, n)."""
    feet, bases = rows_of(batch[index[0] : index[-1] + 1], dtype)
    return np.concatenate([feet[:, None, :], bases], axis=1)
