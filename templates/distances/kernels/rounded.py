"""Lengths of points inside subspaces whose rows are rounded to eight bits."""

import numpy as np
from numpy.typing import NDArray

from templates.distances.kernels.lanes import LANES, compiled, every, fma, load, load_bytes, store


@compiled
def squares_inside(
    rows: NDArray[np.int8],
    steps: NDArray[np.float32],
    point: NDArray[np.float32],
    m: int,
    out: NDArray[np.float32],
) -> None:
    """Write ‖D e‖² of one point and many subspaces, sixteen of them side by side.

    Parameters
    ----------
    rows : (G · m · n · 16,) int8
        Of G groups of sixteen subspaces: number x of row k of each, over all k and x.
    steps : (G · m · 16,) float32
        What a row's numbers are multiples of.
    point : (n,) float32
    out : (G · 16,) float32
    """
    n = len(point)
    width = n * LANES
    for group in range(len(out) // LANES):
        inside = every(np.float32(0))
        for k in range(group * m, (group + 1) * m):
            place = k * width
            # Two sums, because a processor begins an addition before the last one is over.
            even, odd = every(np.float32(0)), every(np.float32(0))
            for x in range(0, n - 1, 2):
                even = fma(load_bytes(rows, place), every(point[x]), even)
                odd = fma(load_bytes(rows, place + LANES), every(point[x + 1]), odd)
                place += 2 * LANES
            if n % 2:
                even = fma(load_bytes(rows, place), every(point[n - 1]), even)
            length = (even + odd) * load(steps, k * LANES)
            inside = fma(length, length, inside)
        store(out, group * LANES, inside)
