"""What the kernels are given, by name."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
Integers = NDArray[np.int64]


class Options(NamedTuple):
    """What is computed, and how well."""

    spherical: bool
    steps: int
    """Of the spherical subspace-to-subspace iteration, at most."""
    least: np.float32
    """A distance that is not above this is −1 in the result: it has lost digits."""
    accuracy: np.float32
    """Largest relative error that a squared Euclidean distance of two subspaces may have."""


class Tile(NamedTuple):
    """Products of R probes and C templates; C is a multiple of 16."""

    product: Array32
    """(R · (m_d + 1) · (m_e + 1) · C,): the rows of a probe, p and D, or only its point, with the
    rows q and E of the templates, the templates side by side."""
    probe_terms: Array32
    """(R,): ‖p‖², or 1/‖e‖ of points with the spherical metric."""
    template_squares: Array32
    """(C,): ‖q‖²."""
    m_d: int
    """Dimension of the probes; 0 of points."""
    m_e: int


class Result(NamedTuple):
    """Where the distances of a tile go."""

    distances: Array32
    """Flat; row r begins at ``r · stride``."""
    stride: int
    width: int
    """Number of distances of a row that are written, at most C."""
