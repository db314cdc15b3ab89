"""Euclidean distances between points and affine subspaces.

Paper eq. 1 to 9; docs/method.md §3.1 and §3.2.

Bulk work uses the cross-Gram matrix in the caller's precision. Where that form cancels (small
distances) or its system is nearly singular (shared decoys, shared directions), the pair is
computed again in float64 from explicit differences.
"""

import numpy as np
from numpy.typing import NDArray

from templates.distances.crossgram import (
    Floats,
    Indices,
    Kind,
    PairTile,
    chunks,
    matched_tiles,
    pair_tiles,
    point_tiles,
)
from templates.space.subspace import SubspaceBatch

NEAR = 0.1
"""Distances below this are computed again in float64: their squares cancel in float32."""

# Relative error of a squared distance that the bulk form may have, by bytes of its numbers.
_BULK_ERROR = {4: 5e-5, 8: 1e-11}
# A direction shared by two subspaces to within this angle is one direction: float32 storage
# turns equal directions by 10⁻⁷. Squared, because eigenvalues of the Gram matrix are compared.
_SHARED_ANGLE2 = 4e-12


def points_pairwise(points: Floats, templates: SubspaceBatch, dtype: Kind) -> Floats:
    """Distances of points (P, n) to templates, shape (P, T)."""
    out = np.empty((len(points), len(templates)), dtype=dtype)
    lengths = _squares(points)
    feet = _squares(templates.feet)
    for rows, columns, dots, spreads in point_tiles(points, templates, dtype):
        squared = (feet[columns, None] + lengths[None, rows] - 2 * dots - spreads).T
        out[rows, columns] = np.sqrt(np.maximum(squared, 0))
        i, j = np.nonzero(squared < NEAR**2)
        if i.size:
            i, j = i + rows.start, j + columns.start
            out[i, j] = points_exact(points, templates, i, j)
    return out


def points_paired(points: Floats, templates: SubspaceBatch, dtype: Kind) -> Floats:
    """Distances of point i to template i, shape (P,)."""
    every = np.arange(len(points))
    return points_exact(points, templates, every, every).astype(dtype)


def points_exact(
    points: Floats, templates: SubspaceBatch, i: Indices, j: Indices
) -> NDArray[np.float64]:
    """Distances of points ``i`` to templates ``j`` by explicit residuals in float64."""
    out = np.empty(len(i))
    for part in chunks(len(i), templates.m * templates.n):
        bases = templates.bases[j[part]].astype(np.float64)
        gaps = points[i[part]].astype(np.float64) - templates.feet[j[part]]
        for _ in range(2):  # once more, because the stored basis is orthonormal to float32 only
            gaps -= (gaps[:, None, :] @ bases.transpose(0, 2, 1) @ bases)[:, 0, :]
        out[part] = np.linalg.norm(gaps, axis=1)
    return out


def subspaces_pairwise(probes: SubspaceBatch, templates: SubspaceBatch, dtype: Kind) -> Floats:
    """Distances of all probes to all templates, shape (P, T)."""
    out = np.empty((len(probes), len(templates)), dtype=dtype)
    norms = _squares(probes.feet), _squares(templates.feet)
    for tile in pair_tiles(probes, templates, dtype):
        out[tile.first, tile.second] = _tile(probes, templates, tile, *norms)
    return out


def subspaces_paired(probes: SubspaceBatch, templates: SubspaceBatch, dtype: Kind) -> Floats:
    """Distances of probe i to template i, shape (P,)."""
    out = np.empty(len(probes), dtype=dtype)
    norms = _squares(probes.feet), _squares(templates.feet)
    for tile in matched_tiles(probes, templates, dtype):
        out[tile.first] = _tile(probes, templates, tile, *norms)
    return out


def _tile(
    probes: SubspaceBatch,
    templates: SubspaceBatch,
    tile: PairTile,
    mine: NDArray[np.float64],
    theirs: NDArray[np.float64],
) -> Floats:
    gaps = (mine[tile.first] + theirs[tile.second]).astype(tile.dots.dtype) - 2 * tile.dots
    with np.errstate(over="ignore", invalid="ignore"):  # in doubtful pairs, computed again below
        squared, doubtful = _schur(gaps, tile)
    distances = np.sqrt(np.maximum(squared, 0))
    again = np.flatnonzero(doubtful)
    if again.size:
        distances[again] = subspaces_exact(probes, templates, tile.first[again], tile.second[again])
    return distances


def _schur(gaps: Floats, tile: PairTile) -> tuple[Floats, NDArray[np.bool_]]:
    """Squared distances by the block formula, and which of them may be inexact.

    With a = D q, b = −E p and w = b − Mᵀa, the squared distance is the last Schur complement of
    [[I − MᵀM, w], [wᵀ, ‖r‖² − ‖a‖²]]: one Cholesky factorisation, for all pairs at once.

    An error δ of the products moves the squared distance by about δ (1 + ‖α‖² + ‖β‖²), where α
    and β are the coefficients of the closest points. That is the test of exactness, with ‖β‖²
    for ‖α‖², from which it differs by 1 at most in the norm.
    """
    left, middle = tile.left, tile.middle
    count, _, m = middle.shape
    transposed = middle.transpose(0, 2, 1)
    normal = np.empty((m + 1, m, count), dtype=middle.dtype)
    normal[:m] = -(transposed @ middle).transpose(1, 2, 0)
    normal[np.arange(m), np.arange(m)] += 1
    normal[m] = -(tile.right + (transposed @ left[:, :, None])[:, :, 0]).T
    squared = gaps - np.einsum("ki,ki->k", left, left)

    precision = np.finfo(middle.dtype).eps
    smallest = 100 * precision  # a pivot below this has no correct digit
    doubtful = np.zeros(count, dtype=np.bool_)
    for step in range(m):
        pivot = normal[step, step]
        doubtful |= ~(pivot > smallest)
        column = normal[step + 1 :, step]
        column /= np.sqrt(np.maximum(pivot, smallest))
        squared -= column[-1] * column[-1]
        for row in range(m - step):
            # Rows below the diagonal, and the right-hand side (the last row) in full.
            width = min(row + 1, m - step - 1)
            target = normal[step + 1 + row, step + 1 : step + 1 + width]
            target -= column[row] * column[:width]
    beta = normal[m]
    for step in range(m - 1, -1, -1):
        beta[step] /= np.sqrt(np.maximum(normal[step, step], smallest))
        beta[:step] -= normal[step, :step] * beta[step]
    sizes = 1 + 2 * np.einsum("ik,ik->k", beta, beta)
    allowed = _BULK_ERROR[middle.dtype.itemsize] * squared
    doubtful |= ~(squared >= NEAR**2) | ~(4 * precision * sizes < allowed)
    return squared, doubtful


def subspaces_exact(
    probes: SubspaceBatch, templates: SubspaceBatch, i: Indices, j: Indices
) -> NDArray[np.float64]:
    """Distances of probes ``i`` to templates ``j`` from explicit differences in float64.

    The residual of q − p after least squares on the rows of both bases, by the eigenvectors of
    their Gram matrix without those that only rounding keeps apart (the minimum-norm solution).
    It is 0 only if the residual is, and defined for parallel and for intersecting subspaces.
    """
    out = np.empty(len(i))
    for part in chunks(len(i), 2 * (probes.m + templates.m) * probes.n):
        mine, theirs = i[part], j[part]
        rows = np.concatenate([probes.bases[mine], templates.bases[theirs]], axis=1)
        rows = rows.astype(np.float64)
        columns = rows.transpose(0, 2, 1)
        values, vectors = np.linalg.eigh(rows @ columns)
        inverse = np.where(values > _SHARED_ANGLE2, 1 / np.maximum(values, _SHARED_ANGLE2), 0)
        gaps = templates.feet[theirs].astype(np.float64) - probes.feet[mine]
        gaps = gaps[:, :, None]
        for _ in range(2):  # the second pass removes the first one's rounding
            inside = vectors.transpose(0, 2, 1) @ (rows @ gaps)
            gaps = gaps - columns @ (vectors @ (inverse[:, :, None] * inside))
        out[part] = np.linalg.norm(gaps[:, :, 0], axis=1)
    return out


def _squares(rows: Floats) -> NDArray[np.float64]:
    """Squared lengths of rows, in float64."""
    return np.asarray(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))
