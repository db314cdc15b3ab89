"""What is kept of a tile of distances where the whole matrix is not: the nearest, and counts."""

import numpy as np

from templates.distances.kernels.arguments import Array32, Integers
from templates.distances.kernels.lanes import ALL, LANES, compiled, every, inlined, less, load


@inlined
def _before(distance: np.float32, column: int, other: np.float32, there: int) -> bool:
    if distance == other:
        return there < 0 or column < there
    return bool(distance < other)


@compiled
def keep_nearest(
    distances: Array32,
    columns: int,
    first: int,
    row_labels: Integers,
    column_labels: Integers,
    best: Array32,
    places: Integers,
) -> None:
    """Merge a tile into the K nearest of every row; the order of tiles does not matter.

    Parameters
    ----------
    distances : (R · C,) float32
        C is ``columns`` rounded up to a multiple of 16; the rest of each row is passed over.
    first
        Number of the tile's first column.
    row_labels, column_labels : (R,) and (columns,) int64
        Pairs with equal labels are passed over; empty arrays where all count.
    best, places : (R, K)
        Distances in ascending order and their columns, updated; of equal ones, the lowest column.
    """
    k = best.shape[1]
    stride = columns + (-columns) % LANES
    labelled = len(row_labels) > 0
    for i in range(len(best)):
        for j in range(0, columns, LANES):
            beyond = less(every(best[i, k - 1]), load(distances, i * stride + j))
            if beyond == ALL:
                continue
            for c in range(j, min(j + LANES, columns)):
                if labelled and row_labels[i] == column_labels[c]:
                    continue
                distance, column = distances[i * stride + c], first + c
                if not _before(distance, column, best[i, k - 1], places[i, k - 1]):
                    continue
                place = k - 1
                while place and _before(distance, column, best[i, place - 1], places[i, place - 1]):
                    best[i, place] = best[i, place - 1]
                    places[i, place] = places[i, place - 1]
                    place -= 1
                best[i, place] = distance
                places[i, place] = column


@compiled
def count_within(
    distances: Array32,
    columns: int,
    thresholds: Array32,
    row_labels: Integers,
    column_labels: Integers,
    counts: Integers,
) -> None:
    """Count the distances whose first threshold is this one.

    Parameters
    ----------
    distances, columns, row_labels, column_labels
        As of :func:`keep_nearest`.
    thresholds : (S,) float32
        Ascending.
    counts : (S,) int64
        ``counts[s]`` grows by the number of distances in (thresholds[s − 1], thresholds[s]].
    """
    last = len(thresholds) - 1
    labelled = len(row_labels) > 0
    stride = columns + (-columns) % LANES
    limit = every(thresholds[last])
    for i in range(len(distances) // stride):
        for j in range(0, columns, LANES):
            beyond = less(limit, load(distances, i * stride + j))
            if beyond == ALL:
                continue
            for c in range(j, min(j + LANES, columns)):
                distance = distances[i * stride + c]
                if not distance <= thresholds[last] or (
                    labelled and row_labels[i] == column_labels[c]
                ):
                    continue
                low, high = 0, last
                while low < high:
                    middle = (low + high) // 2
                    if distance <= thresholds[middle]:
                        high = middle
                    else:
                        low = middle + 1
                counts[low] += 1
