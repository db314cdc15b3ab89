"""What every part of the package speaks of: metrics, steps, neighbours, labels."""

from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

DEFAULT_STEPS = 50
"""Steps of the spherical subspace-to-subspace iteration; part of a calibration."""

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

Labels = tuple[Indices, Indices]
"""One label for each probe and each template; pairs with equal labels do not count."""


class Metric(StrEnum):
    """Which closest points count."""

    EUCLIDEAN = "euclidean"
    """Any of the subspace: the paper's distances."""
    SPHERICAL = "spherical"
    """Those of unit length, as every descriptor is: what the product decides with."""


class Neighbours(NamedTuple):
    """The K nearest of each, nearest first; of equally near ones the lowest index first.

    Where fewer than K could be found, index −1 at an infinite distance.
    """

    indices: Indices
    distances: NDArray[np.float32]
