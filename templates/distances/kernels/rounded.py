"""Products of a lifted probe with templates that are rounded to eight bits.

Reading the templates from memory is what takes the time, so each is read once, as it is stored.
"""

import numpy as np
from numpy.typing import NDArray

from templates.distances.kernels.arguments import Array32
from templates.distances.kernels.lanes import compiled_sums


@compiled_sums
def rounded_products(
    stacked: Array32,
    scaled: Array32,
    feet: Array32,
    numbers: NDArray[np.int8],
    steps: Array32,
    product: Array32,
) -> None:
    """Write the products of a tile.

    Parameters
    ----------
    stacked : (R, n)
        Rows of a probe.
    scaled : (R, n)
        The same, times the scales of the coordinates.
    feet : (T, n)
    numbers : (T, m, n)
    steps : (T, m)
        What the rows of ``numbers`` are multiples of.
    product : (R, m + 1, T or more)
        Of the foot points first.
    """
    rows, n = stacked.shape
    for t in range(len(numbers)):
        for r in range(rows):
            total = np.float32(0)
            for x in range(n):
                total += feet[t, x] * stacked[r, x]
            product[r, 0, t] = total
        for k in range(numbers.shape[1]):
            row = numbers[t, k]
            for r in range(rows):
                probe = scaled[r]
                total = np.float32(0)
                for x in range(n):
                    total += np.float32(row[x]) * probe[x]
                product[r, k + 1, t] = total * steps[t, k]
