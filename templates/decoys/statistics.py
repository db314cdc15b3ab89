"""What a decoy generator knows of real descriptors: moments, not descriptors.

The model, in the coordinates of the principal axes of real descriptors, scaled to unit variance:

- The leading axes carry gender, race, age and pose; the coordinates there come in clusters.
- On all other axes the coordinates are symmetric about zero, but their size is not that of a
  Gaussian: a blurred or turned face has more energy on *all* minor axes at once. Those axes are
  cut into bands of about 32, and the energy of each band is a variable of its own.

So the leading coordinates and the logarithms of the band energies follow one Gaussian mixture,
and inside a band the direction is uniform.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.decoys.source import MAX_DIMENSION
from templates.errors import DecoyError

MAX_LEADING = 16
BAND_WIDTH = 32
MAX_COMPONENTS = 64

# Values far beyond those of unit descriptors, where a float32 sample would overflow or vanish.
_LARGEST_SCALE = 1e3
_SMALLEST_SCALE = 1e-6
_LARGEST_LOG_ENERGY = 10.0

# Decoys in a small subspace leave the hidden descriptor the only direction outside it. Fits of
# real faces measure 0.58 n and more, the demo's drawn faces 0.60 n; so n / 8 refuses no real fit.
_SMALLEST_SHARE = 1 / 8
_CHECKED_FROM = 64
_ORTHOGONAL = 1e-3


def leading_axes(n: int) -> int:
    """Number of axes that are modelled one by one."""
    return min(MAX_LEADING, n // 2)


def band_edges(n: int) -> NDArray[np.int64]:
    """First axis of every band, and n: shape (bands + 1,); a function of n alone."""
    first = leading_axes(n)
    bands = max(1, round((n - first) / BAND_WIDTH))
    return np.linspace(first, n, bands + 1).round().astype(np.int64)


def feature_count(n: int) -> int:
    """Number q of variables of the mixture: leading coordinates, then log band energies."""
    return leading_axes(n) + len(band_edges(n)) - 1


@dataclass(frozen=True, eq=False)
class DescriptorStatistics:
    """The parameters of a `DecoyGenerator`; float32, C-contiguous, read-only, little-endian.

    Attributes
    ----------
    mean
        Shape (n,). Mean of real descriptors.
    axes
        Shape (n, n). Principal axes as rows, each as long as the standard deviation along it,
        longest first.
    weights
        Shape (K,). Weights of the mixture; positive, their sum is 1.
    centres
        Shape (K, q). Means of the mixture's components.
    spreads
        Shape (K, q, q). Lower Cholesky factors of their covariances.

    Raises
    ------
    DecoyError
        Shapes that do not fit, values that are not finite or out of range, axes that are not
        orthogonal, or, from 64 dimensions on, deviations on so few axes that the decoys hide
        nothing (`participation` below n / 8).
    """

    mean: NDArray[np.float32]
    axes: NDArray[np.float32]
    weights: NDArray[np.float32]
    centres: NDArray[np.float32]
    spreads: NDArray[np.float32]

    def __post_init__(self) -> None:
        for name in ("mean", "axes", "weights", "centres", "spreads"):
            array = np.array(getattr(self, name), dtype="<f4", order="C", copy=True)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        self._check_shapes()
        self._check_values()
        self._check_spread()

    def __repr__(self) -> str:
        return f"DescriptorStatistics(n={self.n}, {len(self.weights)} components)"

    @property
    def n(self) -> int:
        """Dimension of the descriptors."""
        return int(self.mean.shape[0])

    @property
    def second_moment(self) -> NDArray[np.float64]:
        """Second moment about the origin of what is drawn, (n, n), before it is scaled to length 1.

        As if coordinates were uncorrelated and of unit variance, as they are of the faces of a fit.
        """
        axes, mean = self.axes.astype(np.float64), self.mean.astype(np.float64)
        return np.asarray(axes.T @ axes + np.outer(mean, mean))

    @property
    def participation(self) -> float:
        """Participation ratio (Σσ)² / Σσ² of the deviations of decoys along the axes: 1 to n."""
        lead, widths = leading_axes(self.n), np.diff(band_edges(self.n))
        weights, centres = self.weights.astype(np.float64), self.centres.astype(np.float64)
        variances = np.sum(self.spreads.astype(np.float64) ** 2, axis=2)
        # The mean of exp(2 E) is exp(2 c + 2 v) for Gaussian log energies E, which draws clip.
        energies = np.exp(np.minimum(2 * (centres + variances)[:, lead:], 40.0))
        squares = np.concatenate(
            [
                weights @ (centres**2 + variances)[:, :lead],
                np.repeat(weights @ energies, widths),
            ]
        )
        sigma = np.linalg.norm(self.axes.astype(np.float64), axis=1) * np.sqrt(squares)
        total = float(np.sum(sigma**2))
        return float(np.sum(sigma)) ** 2 / total if total > 0 else 0.0

    def _check_shapes(self) -> None:
        n = self.mean.shape[0] if self.mean.ndim == 1 else 0
        k = self.weights.shape[0] if self.weights.ndim == 1 else 0
        if not 2 <= n <= MAX_DIMENSION or not 1 <= k <= MAX_COMPONENTS:
            raise DecoyError(
                f"a decoy generator has 2 to {MAX_DIMENSION} dimensions and 1 to "
                f"{MAX_COMPONENTS} components; seen a mean of shape {self.mean.shape} and "
                f"weights of shape {self.weights.shape}"
            )
        q = feature_count(n)
        for name, seen, expected in (
            ("axes", self.axes.shape, (n, n)),
            ("centres", self.centres.shape, (k, q)),
            ("spreads", self.spreads.shape, (k, q, q)),
        ):
            if seen != expected:
                raise DecoyError(f"the {name} must have shape {expected}; seen {seen}")

    def _check_values(self) -> None:
        for array in (self.mean, self.axes, self.weights, self.centres, self.spreads):
            if not np.isfinite(array).all():
                raise DecoyError("the decoy generator holds values that are not finite")
        largest = max(float(np.abs(a).max()) for a in (self.mean, self.axes))
        if largest > _LARGEST_SCALE or float(np.abs(self.axes).max()) < _SMALLEST_SCALE:
            raise DecoyError("the decoy generator holds values far from those of unit embeddings")
        if self.weights.min() <= 0 or abs(float(self.weights.sum(dtype=np.float64)) - 1) > 1e-4:
            raise DecoyError("the weights of the components must be positive and add up to 1")
        energies = slice(leading_axes(self.n), None)
        if (
            float(np.abs(self.centres).max()) > _LARGEST_SCALE
            or float(np.abs(self.spreads).max()) > _LARGEST_SCALE
            or float(np.abs(self.centres[:, energies]).max()) > _LARGEST_LOG_ENERGY
        ):
            raise DecoyError("the components of the decoy generator are out of range")

    def _check_spread(self) -> None:
        lengths = np.linalg.norm(self.axes, axis=1, keepdims=True)
        units = np.divide(self.axes, lengths, out=np.zeros_like(self.axes), where=lengths > 0)
        products = units @ units.T
        np.fill_diagonal(products, 0.0)
        if float(np.abs(products).max()) > _ORTHOGONAL:
            raise DecoyError("the axes of the decoy generator are not orthogonal")
        if self.n >= _CHECKED_FROM and self.participation < _SMALLEST_SHARE * self.n:
            raise DecoyError(
                f"the decoys would spread over {self.participation:.0f} of {self.n} dimensions, "
                f"and would hide nothing; at least {_SMALLEST_SHARE * self.n:.0f} are needed"
            )
