"""A mixture of Gaussians, fitted by expectation-maximisation."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

Array = NDArray[np.float64]

REGULARISATION = 1e-5
"""Added to variances: the log energies vary by about 0.1, and it must be far below its square."""
_STARTS = 3
_STEPS = 300
_CLUSTERING_STEPS = 20
_GAIN = 1e-3
"""Of the mean log likelihood: a mixture a step short of its optimum is as good a generator."""


def fit_mixture(features: Array, components: int) -> tuple[Array, Array, Array]:
    """Fit Gaussian components to features, shape (N, q).

    Returns
    -------
    weights, centres, covariances : (c,), (c, q), (c, q, q) float64
        The best of several fits by likelihood, the same for the same features.

    References
    ----------
    C. M. Bishop, "Pattern Recognition and Machine Learning", 2006, section 9.2.2.
    """
    if components == 1:
        return _maximised(features, np.ones((len(features), 1)))
    # The seed fixes where the expectation-maximisation starts, and nothing else.
    rng = np.random.default_rng(0)
    fits = [_from_start(features, _clusters(features, components, rng)) for _ in range(_STARTS)]
    return max(fits, key=lambda fit: fit[0])[1]


def _from_start(features: Array, shares: Array) -> tuple[float, tuple[Array, Array, Array]]:
    """Log likelihood and mixture that a first assignment (N, c) leads to."""
    likelihood = -np.inf
    for _ in range(_STEPS):
        mixture = _maximised(features, shares)
        joint = log_joint(features, *mixture)
        total = logsumexp(joint, axis=1)
        shares = np.exp(joint - total[:, None])
        before, likelihood = likelihood, float(total.mean())
        if likelihood - before < _GAIN:
            break
    return likelihood, mixture


def log_joint(features: Array, weights: Array, centres: Array, covariances: Array) -> Array:
    """Log density of every row together with every component: shape (N, c)."""
    columns = []
    for weight, centre, covariance in zip(weights, centres, covariances, strict=True):
        root = np.linalg.cholesky(covariance)
        whitened = solve_triangular(root, (features - centre).T, lower=True, check_finite=False)
        scale = 2 * np.log(np.diag(root)).sum() + len(root) * np.log(2 * np.pi)
        columns.append(np.log(weight) - 0.5 * (np.sum(whitened**2, axis=0) + scale))
    return np.stack(columns, axis=1)


def _maximised(features: Array, shares: Array) -> tuple[Array, Array, Array]:
    """The mixture of largest likelihood where row i belongs to component k by ``shares[i, k]``."""
    counts = shares.sum(axis=0) + 10 * np.finfo(np.float64).eps
    centres = (shares.T @ features) / counts[:, None]
    covariances = []
    for share, count, centre in zip(shares.T, counts, centres, strict=True):
        rows = features - centre
        covariance = (rows * share[:, None]).T @ rows / count
        covariances.append(covariance + REGULARISATION * np.eye(len(covariance)))
    return counts / counts.sum(), centres, np.stack(covariances)


def _clusters(features: Array, components: int, rng: np.random.Generator) -> Array:
    """Assign every row to the nearest of a few centres (k-means, spread at first): (N, c)."""
    centres = features[rng.integers(len(features))][None]
    while len(centres) < components:
        nearest = _squares(features, centres).min(axis=1)
        chosen = rng.choice(len(features), p=nearest / nearest.sum()) if nearest.sum() > 0 else 0
        centres = np.vstack([centres, features[chosen]])
    for _ in range(_CLUSTERING_STEPS):
        shares = np.eye(components)[_squares(features, centres).argmin(axis=1)]
        counts = shares.sum(axis=0)[:, None]
        moved = np.where(counts > 0, (shares.T @ features) / np.maximum(counts, 1.0), centres)
        if np.array_equal(moved, centres):
            break
        centres = moved
    return np.asarray(shares)


def _squares(features: Array, centres: Array) -> Array:
    return np.stack([np.sum((features - centre) ** 2, axis=1) for centre in centres], axis=1)
