"""Fitting a generator to many faces of any kind, for few faces of the kind that is enrolled.

A covariance has as many numbers as a small sample can never give, and decoys whose covariance is
that of other people give the enrolled away (docs/decoys.md "Whose photos they are fitted to"). So
the sample says in three steps how the many are to be used, each of which needs little of it:

1. The faces are weighted by a classifier that tells them from the sample, so that those count most
   that could be of it.
2. The variance is rescaled in bands of neighbouring principal axes to that of the sample.
3. The covariance is the mean of the result's and the sample's own: the expectation under an inverse
   Wishart prior.

How far to trust the classifier and the sample is found on people of the sample who are left out.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from templates.decoys.fitting import (
    MIN_DESCRIPTORS,
    checked_descriptors,
    mixture_features,
    principal_statistics,
)
from templates.decoys.statistics import DescriptorStatistics, leading_axes
from templates.errors import DecoyError

Array = NDArray[np.float64]

BAND = 16
TRUSTS = (0.0, 0.35, 0.6)
"""Powers of the classifier's odds; 1 would be right if there were faces of the kind in plenty."""
SHARES = tuple(np.linspace(0.02, 0.8, 27).tolist())
_FOLDS = 3
_LARGEST_LOG_ODDS = 6.0
_PENALTY = 0.01
_FLOOR = 1e-7
"""Of the largest variance; an axis on which the many do not vary at all gets it before bands."""


def adapted_statistics(
    descriptors: NDArray[np.floating],
    like: NDArray[np.floating],
    people: Sequence[str],
) -> DescriptorStatistics:
    """Estimate the statistics of a kind of faces from many of any kind and few of it.

    Parameters
    ----------
    descriptors
        float32, shape (N, n), unit rows, N ≥ 100: the many, of one or several kinds, none of them
        in ``like``.
    like
        float32, shape (K, n), unit rows, K ≥ 100: the few.
    people
        K names; photos of one person are left out together.

    Returns
    -------
    DescriptorStatistics

    Raises
    ------
    DecoyError
        Too few of either, or of people in the sample; rows that are not finite unit vectors, or
        that hardly vary.

    Notes
    -----
    The weights of step 1 are importance weights by density-ratio estimation [1]_, tempered as
    their variance asks; step 3 is the posterior mean [2]_ with its degrees of freedom chosen by
    cross-validated likelihood. docs/decoys.md has what the choices give an attacker.

    References
    ----------
    .. [1] M. Sugiyama, T. Suzuki & T. Kanamori, "Density Ratio Estimation in Machine Learning",
       2012, chapter 4.
    .. [2] T. W. Anderson, "An Introduction to Multivariate Statistical Analysis", 2003,
       chapter 7.
    """
    faces = checked_descriptors(descriptors)
    sample, folds = _checked_sample(like, people, n=faces.shape[1])
    scores = np.zeros((len(TRUSTS), len(SHARES)))
    for number in range(_FOLDS):
        scores += _scores(faces, sample[folds != number], sample[folds == number])
    best_trust, best_share = np.unravel_index(int(scores.argmax()), scores.shape)
    weights = _weights(_log_odds(faces, sample), TRUSTS[int(best_trust)])
    share = SHARES[int(best_share)]
    covariance = (1 - share) * _prior(faces, weights, sample) + share * np.cov(sample, rowvar=False)
    return _statistics(faces, weights, mean=sample.mean(axis=0), covariance=covariance)


def _checked_sample(
    like: NDArray[np.floating], people: Sequence[str], *, n: int
) -> tuple[Array, NDArray[np.int64]]:
    """The sample, and the fold that each row is left out in."""
    if np.ndim(like) != 2 or len(like) < MIN_DESCRIPTORS:
        raise DecoyError(
            f"decoys are adapted to {MIN_DESCRIPTORS} or more embeddings of the kind that will be "
            f"enrolled, and {len(like)} are there: give more photos, or adapt to none"
        )
    sample = checked_descriptors(like)
    if sample.shape[1] != n:
        raise DecoyError(
            f"embeddings of {sample.shape[1]} numbers cannot adapt a fit to embeddings of {n}: "
            "make both with one model"
        )
    names, person = np.unique(np.asarray(people, dtype=np.str_), return_inverse=True)
    if len(person) != len(sample):
        raise DecoyError(f"{len(person)} names do not fit {len(sample)} embeddings")
    if len(names) < MIN_DESCRIPTORS // 2:
        raise DecoyError(
            f"decoys are adapted to {MIN_DESCRIPTORS // 2} or more people, and the sample shows "
            f"{len(names)}: give photos of more people"
        )
    fold_of = np.random.default_rng(0).permutation(len(names)) % _FOLDS
    return sample, fold_of[person]


def _scores(faces: Array, fitted: Array, unseen: Array) -> Array:
    """Log likelihood of people who are not in the fit, by trust and share."""
    scores = np.empty((len(TRUSTS), len(SHARES)))
    covariance = np.cov(fitted, rowvar=False)
    odds = _log_odds(faces, fitted)
    centred = unseen - fitted.mean(axis=0)
    for row, trust in enumerate(TRUSTS):
        variances, axes = np.linalg.eigh(_prior(faces, _weights(odds, trust), fitted))
        variances = np.maximum(variances, _FLOOR * variances[-1])
        whitening = axes / np.sqrt(variances)
        ratios, turn = np.linalg.eigh(whitening.T @ covariance @ whitening)
        squares = np.sum((centred @ whitening @ turn) ** 2, axis=0)
        for column, share in enumerate(SHARES):
            mixed = 1 - share + share * np.maximum(ratios, 0.0)
            logs = np.log(mixed).sum() + np.log(variances).sum()
            scores[row, column] = -0.5 * (len(unseen) * logs + np.sum(squares / mixed))
    return scores


def _log_odds(faces: Array, sample: Array) -> Array:
    """Log odds of each face to be of the sample's kind, less a constant: shape (N,).

    By its leading coordinates (who it shows) and by its energies (how well).
    """
    rows = np.vstack([faces, sample])
    _, axes = np.linalg.eigh(np.cov(faces, rowvar=False))
    coordinates = (rows - faces.mean(axis=0)) @ axes[:, ::-1]
    coordinates /= np.maximum(np.sqrt(np.mean(coordinates[: len(faces)] ** 2, axis=0)), 1e-12)
    energies = mixture_features(coordinates)[:, leading_axes(faces.shape[1]) :]
    leading = coordinates[:, : max(2, faces.shape[1] // 8)]
    features = np.hstack([leading, energies, energies**2])
    features = (features - features.mean(axis=0)) / np.maximum(features.std(axis=0), 1e-12)
    truth = np.arange(len(rows)) >= len(faces)
    return np.asarray(features[: len(faces)] @ _separating(features, truth))


def _separating(features: Array, truth: NDArray[np.bool_]) -> Array:
    """Weights (q,) of the ridge logistic regression in which both classes count the same."""
    from scipy.optimize import minimize  # here: every command and worker would wait for it

    rows = np.hstack([features, np.ones((len(features), 1))])
    sides = np.where(truth, 1.0, -1.0)
    counts = np.where(truth, 0.5 / truth.mean(), 0.5 / (1 - truth.mean()))
    ridge = np.append(np.full(features.shape[1], 1 / _PENALTY), 0.0)  # none on the constant

    def loss(weights: Array) -> tuple[float, Array]:
        margins = sides * (rows @ weights)
        pulls = -counts * sides * expit(-margins)
        value = counts @ np.logaddexp(0.0, -margins) + 0.5 * ridge @ weights**2
        return float(value), rows.T @ pulls + ridge * weights

    start = np.zeros(rows.shape[1])
    fitted = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 200})
    return np.asarray(fitted.x[:-1], dtype=np.float64)


def _weights(log_odds: Array, trust: float) -> Array:
    """Weights of the faces, shape (N,); their sum is 1."""
    weights = np.exp(np.clip(trust * log_odds, -_LARGEST_LOG_ODDS, _LARGEST_LOG_ODDS))
    return np.asarray(weights / weights.sum())


def _prior(faces: Array, weights: Array, sample: Array) -> Array:
    """Covariance of the weighted faces, its variance in every band as in the sample: (n, n)."""
    centred = faces - weights @ faces
    variances, axes = np.linalg.eigh((centred * weights[:, None]).T @ centred)
    variances, axes = variances[::-1], axes[:, ::-1]
    variances = np.maximum(variances, _FLOOR * variances[0])
    energies = np.mean(((sample - sample.mean(axis=0)) @ axes) ** 2, axis=0)
    starts = np.arange(0, len(variances), BAND)
    gains = np.add.reduceat(energies, starts) / np.add.reduceat(variances, starts)
    widths = np.diff(np.append(starts, len(variances)))
    scaled = variances * np.repeat(np.maximum(gains, 1e-6), widths)
    return np.asarray((axes * scaled) @ axes.T)


def _statistics(
    faces: Array, weights: Array, *, mean: Array, covariance: Array
) -> DescriptorStatistics:
    """Statistics of that mean and covariance, whose clusters and sizes are the faces'."""
    variances, columns = np.linalg.eigh(covariance)
    deviations = np.sqrt(np.maximum(variances[::-1], 0.0))
    axes = np.ascontiguousarray(columns[:, ::-1].T)
    coordinates = (faces - weights @ faces) @ axes.T
    scale = np.sqrt(weights @ coordinates**2)
    whitened = coordinates / np.maximum(scale, 1e-12)
    lead = leading_axes(faces.shape[1])
    inside = (whitened[:, :lead] * weights[:, None]).T @ whitened[:, :lead]
    values, turn = np.linalg.eigh(inside)
    whitened[:, :lead] @= (turn / np.sqrt(np.maximum(values, 1e-6))) @ turn.T
    # As many faces as the weights are worth, each as often as its weight asks.
    worth = max(MIN_DESCRIPTORS, int(1 / np.sum(weights**2)))
    places = (np.arange(worth) + 0.5) / worth
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(faces) - 1)
    return principal_statistics(mean, axes, deviations, whitened[chosen])
