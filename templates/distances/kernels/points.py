"""Distances of points to subspaces from a tile of the cross-Gram matrix."""

import numpy as np

from templates.distances.kernels.arguments import Options, Result, Tile
from templates.distances.kernels.lanes import (
    ALL,
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


@compiled
def points(tile: Tile, options: Options, out: Result) -> int:
    """Distances of the tile's points; return the number of groups of pairs with a −1.

    Squared, ‖e‖² + ‖p‖² − 2 e·p − ‖D e‖² (paper eq. 1), or 2 − 2 sim with the similarity
    (e·p + s‖D e‖)/‖e‖ from the rows p and s D (docs/method.md §3.4).
    """
    product, columns, m = tile.product, len(tile.template_squares), tile.m_e
    zero, two, minus_two = every(np.float32(0)), every(np.float32(2)), every(np.float32(-2))
    limit, unknown = every(options.least * options.least), every(np.float32(-1))
    inexact = 0
    for i in range(len(tile.probe_terms)):
        own = every(tile.probe_terms[i])
        for j in range(0, columns, LANES):
            place = i * (m + 1) * columns + j
            dots, inside = load(product, place), zero
            for _ in range(m):
                place += columns
                x = load(product, place)
                inside = fma(x, x, inside)
            if options.spherical:
                squared = larger(fma(minus_two, (dots + root(inside)) * own, two), zero)
            else:
                squared = fma(minus_two, dots, own + load(tile.template_squares, j)) - inside
            known = less(limit, squared) & less(squared, every(OVERFLOW))
            inexact += known != ALL
            distance = blend(known, root(squared), unknown)
            put(out.distances, i * out.stride + j, out.width - j, distance)
    return inexact
