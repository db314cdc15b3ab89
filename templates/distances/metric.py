"""What every part of the package speaks of: metrics, steps, neighbours."""

from enum import StrEnum
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from templates.space.subspace import SubspaceBatch

DEFAULT_STEPS = 50
"""Steps of the spherical subspace-to-subspace iteration; part of a calibration."""

NEAR = 0.1
"""Distances below this are computed by ``exact``: their squares cancel in float32."""
ACCURACY = 5e-5
"""Largest relative error that a squared Euclidean distance of two subspaces may have in float32."""
STILL = 3e-5
"""In float32, a pair rests when a step of the iteration moves v by less; what is left of the
similarity is of the order of its square."""
LONGEST = 1e3
"""Extrapolations of the iteration that are longer than this are rounding noise."""

Array32 = NDArray[np.float32]
Floats = NDArray[np.floating[Any]]
_Number = TypeVar("_Number", float, NDArray[np.floating[Any]])
Indices = NDArray[np.int64]

Probes = Array32 | NDArray[np.float64] | SubspaceBatch
Tile = tuple[slice, slice, Floats]
"""Probes and templates of a part of the matrix, and their distances (R, C)."""


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


def similarity(distance: _Number) -> _Number:
    """Return 1 − distance²/2: the cosine on the unit sphere, and one scale for both metrics."""
    return 1 - distance**2 / 2


def parts(count: int, step: int) -> list[slice]:
    """Split ``count`` items into parts of at most ``step``."""
    return [slice(start, min(start + step, count)) for start in range(0, count, step or 1)]
