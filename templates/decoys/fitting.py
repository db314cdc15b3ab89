"""Fitting the decoy generator's statistics to real descriptors."""

import numpy as np
from numpy.typing import NDArray

from templates.decoys.mixture import fit_mixture
from templates.decoys.statistics import DescriptorStatistics, band_edges, leading_axes
from templates.errors import DecoyError

MIN_DESCRIPTORS = 100
FACES_PER_DIMENSION = 4
"""Below that many fitted faces, membership of the fit shows in the statistics (docs/decoys.md)."""
MAX_DESCRIPTORS = 2_000_000
_FOLDS = 10
_COMPONENTS = 4
_PER_COMPONENT = 500
"""A component describes at least hundreds of people on average: it is a crowd, not a person."""
_UNIT_TOLERANCE = 1e-3


def fit_statistics(descriptors: NDArray[np.floating]) -> DescriptorStatistics:
    """Estimate the statistics of real descriptors.

    Parameters
    ----------
    descriptors
        float32, shape (N, n), unit rows (tolerance 1e-3), N ≥ 100; several thousand give good
        decoys, and with N < n single people could be recognised in the result.

    Returns
    -------
    DescriptorStatistics
        The same for the same descriptors on one machine; another processor, BLAS or number of
        threads rounds differently, and so gives another `source_id`.

    Raises
    ------
    DecoyError
        Too few descriptors, descriptors that are not finite unit vectors, or that hardly vary.

    Notes
    -----
    The variance along a sample's own principal axes is biased: too large along the first, too
    small along the last (by 40 % at N = 7 n). Everything but the axes themselves is therefore
    estimated on descriptors that took no part in finding the axes, by cross-fitting [1]_.

    References
    ----------
    .. [1] D. Bartz, "Cross-validation based nonlinear shrinkage", 2016.
    """
    x = checked_descriptors(descriptors)
    mean = x.mean(axis=0)
    axes = principal_axes(x)
    coordinates = cross_fitted(x, axes)
    deviations = np.sqrt(np.mean(coordinates**2, axis=0))
    if deviations[0] <= 1e-6:
        raise DecoyError("the embeddings to fit hardly differ from each other")
    # An axis on which nothing varies stays an axis on which nothing varies.
    return principal_statistics(mean, axes, deviations, coordinates / np.maximum(deviations, 1e-12))


def principal_statistics(
    mean: NDArray[np.float64],
    axes: NDArray[np.float64],
    deviations: NDArray[np.float64],
    whitened: NDArray[np.float64],
) -> DescriptorStatistics:
    """Put the statistics together; the clusters and sizes are those of (N, n) whitened rows."""
    components = int(np.clip(len(whitened) // _PER_COMPONENT, 1, _COMPONENTS))
    weights, centres, covariances = fit_mixture(mixture_features(whitened), components)
    return DescriptorStatistics(
        mean=mean.astype(np.float32),
        axes=(axes * deviations[:, None]).astype(np.float32),
        weights=weights.astype(np.float32),
        centres=centres.astype(np.float32),
        spreads=np.linalg.cholesky(covariances).astype(np.float32),
    )


def checked_descriptors(descriptors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return descriptors that a fit can take, as float64; otherwise raise `DecoyError`."""
    x = np.asarray(descriptors)
    if x.ndim != 2 or not MIN_DESCRIPTORS <= x.shape[0] <= MAX_DESCRIPTORS or x.shape[1] < 2:
        raise DecoyError(
            f"a decoy generator is fitted to {MIN_DESCRIPTORS} or more embeddings, shape (N, n); "
            f"seen {x.shape}"
        )
    x = x.astype(np.float64)
    # Written so that a NaN fails it too.
    if not np.all(np.abs(np.linalg.norm(x, axis=1) - 1.0) <= _UNIT_TOLERANCE):
        raise DecoyError("the embeddings to fit are not all finite unit vectors")
    return x


def principal_axes(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Eigenvectors of the covariance as rows, largest variance first."""
    _, vectors = np.linalg.eigh(np.cov(x, rowvar=False))
    return np.ascontiguousarray(vectors[:, ::-1].T)


def cross_fitted(x: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coordinates of every descriptor along axes that were found without it, shape (N, n).

    The leading axes of a fold span nearly the same space as those of all descriptors, but may
    come in another order or sign; a rotation inside that space makes them comparable. On the
    minor axes only the energy of a band counts, which needs no such care.
    """
    lead = leading_axes(x.shape[1])
    fold = np.arange(len(x)) % _FOLDS
    coordinates = np.empty_like(x)
    for number in range(_FOLDS):
        others = x[fold != number]
        own_axes = principal_axes(others)
        u, _, vt = np.linalg.svd(axes[:lead] @ own_axes[:lead].T)
        own_axes[:lead] = u @ vt @ own_axes[:lead]
        coordinates[fold == number] = (x[fold == number] - others.mean(axis=0)) @ own_axes.T
    return coordinates


def mixture_features(whitened: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leading coordinates, then half the log mean square of every band: shape (N, q)."""
    n = whitened.shape[1]
    edges = band_edges(n)
    squares = np.add.reduceat(whitened**2, edges[:-1], axis=1) / np.diff(edges)
    log_energies = 0.5 * np.log(np.maximum(squares, 1e-8))
    return np.hstack([whitened[:, : leading_axes(n)], log_energies])
