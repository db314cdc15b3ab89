"""Distances of points to subspaces from a tile of the cross-Gram matrix."""

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
)

Floats = NDArray[np.float32]


@compiled
def euclidean_points(
    tile: Floats,
    mine: Floats,
    theirs: Floats,
    m: int,
    least: np.float32,
    out: Floats,
    stride: int,
    count: int,
) -> int:
    """Distances by ‖e‖² + ‖p‖² − 2 e·p − ‖D e‖² (paper eq. 1).

    Parameters
    ----------
    tile : (R · (m + 1) · C,) float32
        Products of R points with the rows p and D of C templates, the templates side by side.
        C is a multiple of 16.
    mine : (R,) float32
        ‖e‖².
    theirs : (C,) float32
        ‖p‖².
    least
        A distance that is not above this is −1 in ``out``: its square has lost digits. So is one
        whose square overflows.
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
    limit = every(least * least)
    unknown = every(np.float32(-1))
    two = every(np.float32(-2))
    found = 0
    for i in range(len(mine)):
        start = i * (m + 1) * columns
        length = every(mine[i])
        for j in range(0, columns, LANES):
            inside = every(np.float32(0))
            place = start + j
            dots = load(tile, place)
            for _ in range(m):
                place += columns
                x = load(tile, place)
                inside = fma(x, x, inside)
            squared = fma(two, dots, length + load(theirs, j)) - inside
            known = less(limit, squared) & less(squared, every(OVERFLOW))
            found += known != 0xFFFF
            distance = blend(known, root(squared), unknown)
            put(out, i * stride + j, count - j, distance)
    return found


@compiled
def spherical_points(
    tile: Floats,
    mine: Floats,
    columns: int,
    m: int,
    least: np.float32,
    out: Floats,
    stride: int,
    count: int,
) -> int:
    """Distances by sim = (e·p + s‖D e‖)/‖e‖ (docs/method.md §3.4), from the rows p and s D.

    Parameters
    ----------
    mine : (R,) float32
        1/‖e‖.
    tile, least, out, stride, count
        As of :func:`euclidean_points`, and so is the result.
    """
    limit = every(least)
    unknown = every(np.float32(-1))
    two, minus_two = every(np.float32(2)), every(np.float32(-2))
    zero = every(np.float32(0))
    found = 0
    for i in range(len(mine)):
        start = i * (m + 1) * columns
        scale = every(mine[i])
        for j in range(0, columns, LANES):
            inside = zero
            place = start + j
            dots = load(tile, place)
            for _ in range(m):
                place += columns
                x = load(tile, place)
                inside = fma(x, x, inside)
            similarity = (dots + root(inside)) * scale
            distance = root(larger(fma(minus_two, similarity, two), zero))
            known = less(limit, distance)
            found += known != 0xFFFF
            distance = blend(known, distance, unknown)
            put(out, i * stride + j, count - j, distance)
    return found
