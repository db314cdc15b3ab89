"""Euclidean distances of pairs of subspaces from a tile of the cross-Gram matrix."""

import numpy as np
from numpy.typing import NDArray

from templates.distances.kernels.lanes import (
    LANES,
    OVERFLOW,
    blend,
    compiled,
    every,
    fma,
    larger,
    less,
    load,
    put,
    root,
    store,
)

Floats = NDArray[np.float32]

_PAD = 4
_EPS = np.float32(np.finfo(np.float32).eps)


def scratch_size(m_d: int, m_e: int) -> int:
    """Floats of working space that :func:`euclidean_subspaces` needs."""
    high, low = max(m_d, m_e), min(m_d, m_e)
    stride = low + _PAD
    return LANES * (high * stride + stride * stride + 2 * stride)


@compiled
def euclidean_subspaces(
    tile: Floats,
    mine: Floats,
    theirs: Floats,
    m_d: int,
    m_e: int,
    least: np.float32,
    accuracy: np.float32,
    work: Floats,
    out: Floats,
    stride: int,
    count: int,
) -> int:
    """Distances by one Cholesky factorisation, for sixteen pairs at once.

    With M = D Eᵀ, a = D q and b = −E p, the squared distance is the last pivot of the
    factorisation of [[I − MᵀM, b − Mᵀa], [·, ‖p − q‖² − ‖a‖²]]. MᵀM is accumulated in the same
    registers, and the larger of the two subspaces stands in the place of D.

    Parameters
    ----------
    tile : (R · (m_d + 1) · (m_e + 1) · C,) float32
        Products of the rows p and D of R probes with the rows q and E of C templates, the
        templates side by side. C is a multiple of 16.
    mine : (R,) float32
        ‖p‖².
    theirs : (C,) float32
        ‖q‖².
    least
        Distances that are not above this are −1 in ``out``, and so are those of nearly singular
        pairs and those whose squares overflow.
    accuracy
        Largest relative error that a squared distance may have.
    work : float32
        Of ``scratch_size(m_d, m_e)`` numbers, zeros.
    out : flat float32
        Row r of the distances is written from ``r · stride`` on.
    count
        Number of distances of a row that are written, at most C.

    Returns
    -------
    int
        Number of groups of pairs with a −1.
    """
    columns = len(theirs)
    swapped = m_e > m_d
    high, low = (m_e, m_d) if swapped else (m_d, m_e)
    wide = low + _PAD
    of_factor = high * wide * LANES
    of_inverse = of_factor + wide * wide * LANES
    of_beta = of_inverse + wide * LANES
    # In the tile, one step along a row of M, and one down.
    across, down = columns, (m_e + 1) * columns
    if swapped:
        across, down = down, across
    zero, one = every(np.float32(0)), every(np.float32(1))
    smallest = every(np.float32(100) * _EPS)
    limit = every(least * least)
    found = 0
    for i in range(len(mine)):
        for j in range(0, columns, LANES):
            origin = i * (m_d + 1) * (m_e + 1) * columns + j
            for a in range(high):
                for e in range(low):
                    x = load(tile, origin + (a + 1) * down + (e + 1) * across)
                    store(work, (a * wide + e) * LANES, x)
                store(work, (a * wide + low) * LANES, load(tile, origin + (a + 1) * down))
            gap = every(mine[i]) + load(theirs, j)
            gap = fma(every(np.float32(-2)), load(tile, origin), gap)
            sound = 0xFFFF
            squared = zero
            for k in range(low + 1):
                for r in range(k, low + 1, _PAD):
                    s0, s1, s2, s3 = zero, zero, zero, zero
                    for a in range(high):
                        place = (a * wide + r) * LANES
                        x = load(work, (a * wide + k) * LANES)
                        s0 = fma(load(work, place), x, s0)
                        s1 = fma(load(work, place + LANES), x, s1)
                        s2 = fma(load(work, place + 2 * LANES), x, s2)
                        s3 = fma(load(work, place + 3 * LANES), x, s3)
                    place = of_factor + r * wide * LANES
                    pivot_row = of_factor + k * wide * LANES
                    for t in range(k):
                        x = load(work, pivot_row + t * LANES)
                        s0 = fma(load(work, place + t * LANES), x, s0)
                        s1 = fma(load(work, place + (t + wide) * LANES), x, s1)
                        s2 = fma(load(work, place + (t + 2 * wide) * LANES), x, s2)
                        s3 = fma(load(work, place + (t + 3 * wide) * LANES), x, s3)
                    place += k * LANES
                    store(work, place, zero - s0)
                    store(work, place + wide * LANES, zero - s1)
                    store(work, place + 2 * wide * LANES, zero - s2)
                    store(work, place + 3 * wide * LANES, zero - s3)
                corner = of_factor + (k * wide + k) * LANES
                if k == low:
                    squared = load(work, corner) + gap
                    break
                pivot = load(work, corner) + one
                sound &= less(smallest, pivot)
                inverse = one / root(larger(pivot, smallest))
                store(work, of_inverse + k * LANES, inverse)
                right = load(tile, origin + (k + 1) * across)
                last = of_factor + (low * wide + k) * LANES
                store(work, last, load(work, last) - right)
                for r in range(k + 1, low + 1):
                    place = of_factor + (r * wide + k) * LANES
                    store(work, place, load(work, place) * inverse)
            # An error of the products moves the square by that times the coefficients' squares.
            size = one
            for k in range(low - 1, -1, -1):
                beta = load(work, of_factor + (low * wide + k) * LANES)
                for r in range(k + 1, low):
                    x = load(work, of_factor + (r * wide + k) * LANES)
                    beta = beta - x * load(work, of_beta + r * LANES)
                beta = beta * load(work, of_inverse + k * LANES)
                store(work, of_beta + k * LANES, beta)
                size = size + beta * (beta + beta)
            sound &= less(limit, squared) & less(squared, every(OVERFLOW))
            sound &= less(every(np.float32(4) * _EPS) * size, every(accuracy) * squared)
            found += sound != 0xFFFF
            distance = blend(sound, root(squared), every(np.float32(-1)))
            put(out, i * stride + j, count - j, distance)
    return found
