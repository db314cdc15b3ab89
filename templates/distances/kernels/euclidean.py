"""Euclidean distances of pairs of subspaces from a tile of the cross-Gram matrix."""

import numpy as np

from templates.distances.kernels.arguments import Array32, Options, Result, Tile
from templates.distances.kernels.lanes import (
    ALL,
    LANES,
    OVERFLOW,
    blend,
    compiled,
    every,
    fma,
    fma4,
    larger,
    less,
    load,
    put,
    root,
    store,
    store4,
)

_PAD = 4
_EPS = np.float32(np.finfo(np.float32).eps)


def scratch_size(m_d: int, m_e: int) -> int:
    """Numbers of working space that :func:`euclidean_subspaces` needs."""
    high, low = max(m_d, m_e), min(m_d, m_e)
    stride = low + _PAD
    return LANES * (high * stride + stride * stride + 2 * stride)


@compiled
def euclidean_subspaces(tile: Tile, options: Options, work: Array32, out: Result) -> int:
    """Distances by one Cholesky factorisation, for sixteen pairs at once.

    With M = D Eᵀ, a = D q and b = −E p, the squared distance is the last pivot of the
    factorisation of [[I − MᵀM, b − Mᵀa], [·, ‖p − q‖² − ‖a‖²]]. MᵀM is accumulated in the same
    registers, and the larger of the two subspaces stands in the place of D.

    Parameters
    ----------
    work : float32
        Of ``scratch_size(m_d, m_e)`` numbers, zeros.

    Returns
    -------
    int
        Number of groups of pairs with a −1: a distance that is not above the least, whose square
        overflows, or of a nearly singular pair.
    """
    product, columns, m_d, m_e = tile.product, len(tile.template_squares), tile.m_d, tile.m_e
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
    limit = every(options.least * options.least)
    inexact = 0
    for i in range(len(tile.probe_terms)):
        for j in range(0, columns, LANES):
            origin = i * (m_d + 1) * (m_e + 1) * columns + j
            for a in range(high):
                for e in range(low):
                    x = load(product, origin + (a + 1) * down + (e + 1) * across)
                    store(work, (a * wide + e) * LANES, x)
                store(work, (a * wide + low) * LANES, load(product, origin + (a + 1) * down))
            gap = every(tile.probe_terms[i]) + load(tile.template_squares, j)
            gap = fma(every(np.float32(-2)), load(product, origin), gap)
            sound = ALL
            squared = zero
            for k in range(low + 1):
                for r in range(k, low + 1, _PAD):
                    # Minus the sums: of the rows of −M and, factor by factor, of what is known.
                    sums = zero, zero, zero, zero
                    for a in range(high):
                        x = zero - load(work, (a * wide + k) * LANES)
                        sums = fma4(work, (a * wide + r) * LANES, LANES, x, sums)
                    place = of_factor + r * wide * LANES
                    for t in range(k):
                        x = zero - load(work, of_factor + (k * wide + t) * LANES)
                        sums = fma4(work, place + t * LANES, wide * LANES, x, sums)
                    store4(work, place + k * LANES, wide * LANES, sums)
                corner = of_factor + (k * wide + k) * LANES
                if k == low:
                    squared = load(work, corner) + gap
                    break
                pivot = load(work, corner) + one
                sound &= less(smallest, pivot)
                inverse = one / root(larger(pivot, smallest))
                store(work, of_inverse + k * LANES, inverse)
                right = load(product, origin + (k + 1) * across)
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
            sound &= less(every(np.float32(4) * _EPS) * size, every(options.accuracy) * squared)
            inexact += sound != ALL
            distance = blend(sound, root(squared), every(np.float32(-1)))
            put(out.distances, i * out.stride + j, out.width - j, distance)
    return inexact
