"""Fitting the decoys' Gaussian: to many faces of any kind, or also to few of the kind enrolled.

A covariance has more numbers than a small sample can give, and decoys whose covariance is that of
other people give the enrolled away (docs/method.md "The decoys"). So the sample says in three steps
how the many faces are to be used, and each step needs little of it:

1. The faces are weighted by a classifier that tells them from the sample, so that those count most
   that could be of it.
2. The variance is rescaled, in bands of neighbouring principal axes, to that of the sample.
3. The covariance is the mean of the result and the sample's own, the expectation under an inverse
   Wishart prior. How much the sample counts is found on people of it who are left out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from templates.errors import DecoyError
from templates.space.embedding import unit_descriptors

Array = NDArray[np.float64]

MIN_DESCRIPTORS = 100
FACES_PER_DIMENSION = 4
"""With fewer faces for each number of an embedding, membership of the fit shows in the decoys."""
MAX_DESCRIPTORS = 2_000_000
BAND = 16
TRUST = 0.6
"""Power of the classifier's odds; 1 would be right if the many held the sample's kind in plenty."""
SHARES = tuple(np.linspace(0.02, 0.8, 27).tolist())
_FOLDS = 3
_CROSS_FOLDS = 10
_LARGEST_LOG_ODDS = 6.0
_RIDGE = 100.0
_NEWTON_STEPS = 30
_FLOOR = 1e-7
"""Of the largest variance; the least that an axis has on which the faces do not vary at all."""


class Moments(NamedTuple):
    """Orthonormal axes of faces, as columns (n, n), and moments of the coordinates along them."""

    axes: Array
    mean: Array
    covariance: Array


def fit_moments(descriptors: NDArray[np.floating]) -> Moments:
    """Estimate the mean and the covariance of faces from unit rows (N, n), N ≥ 100.

    Several thousand give good decoys, and with N < n single people could be recognised in the
    result. The variance along a sample's own principal axes is biased: too large along the first,
    too small along the last. So it is estimated on embeddings that took no part in finding the axes
    (D. Bartz, "Cross-validation based nonlinear shrinkage", 2016).
    """
    faces = checked_descriptors(descriptors)
    axes = _principal_axes(faces)
    fold = np.arange(len(faces)) % _CROSS_FOLDS
    squares = np.zeros(faces.shape[1])
    for number in range(_CROSS_FOLDS):
        others = faces[fold != number]
        left_out = faces[fold == number] - others.mean(axis=0)
        squares += np.sum((left_out @ _principal_axes(others)) ** 2, axis=0)
    return Moments(axes, faces.mean(axis=0) @ axes, np.diag(squares / len(faces)))


def adapted_moments(
    descriptors: NDArray[np.floating], like: NDArray[np.floating], people: Sequence[str]
) -> Moments:
    """Estimate the moments of a kind of faces from many of any kind and few of it.

    Parameters
    ----------
    descriptors
        float32, shape (N, n), unit rows, N ≥ 100: the many, none of them in ``like``.
    like
        float32, shape (K, n), unit rows, K ≥ 100: the few.
    people
        K names; photos of one person are left out together.

    Returns
    -------
    Moments
        Along the axes of the many.

    Raises
    ------
    DecoyError
        Too few of either, or of people in the sample; rows that are not finite unit vectors, or
        that hardly vary.

    References
    ----------
    M. Sugiyama, T. Suzuki & T. Kanamori, "Density Ratio Estimation in Machine Learning", 2012,
    chapter 4, for the weights; T. W. Anderson, "An Introduction to Multivariate Statistical
    Analysis", 2003, chapter 7, for the posterior mean of the covariance.
    """
    many = checked_descriptors(descriptors)
    few, fold = _checked_sample(like, people, n=many.shape[1])
    axes = _principal_axes(many)
    faces, sample = many @ axes, few @ axes
    scores = np.zeros(len(SHARES))
    for number in range(_FOLDS):
        scores += _scores(faces, sample[fold != number], sample[fold == number])
    share = SHARES[int(scores.argmax())]
    covariance = (1 - share) * _prior(faces, sample) + share * np.cov(sample, rowvar=False)
    return Moments(axes, sample.mean(axis=0), covariance)


def checked_descriptors(descriptors: NDArray[np.floating]) -> Array:
    """Return embeddings that a fit can take, as float64; otherwise raise a `TemplateError`."""
    x = np.asarray(descriptors)
    if x.ndim != 2 or not MIN_DESCRIPTORS <= x.shape[0] <= MAX_DESCRIPTORS or x.shape[1] < 2:
        raise DecoyError(
            f"a decoy generator is fitted to {MIN_DESCRIPTORS} or more embeddings, shape (N, n); "
            f"seen {x.shape}"
        )
    return unit_descriptors(x)


def _principal_axes(x: Array) -> Array:
    """Eigenvectors of the covariance as columns, of the largest variance first."""
    variances, vectors = np.linalg.eigh(np.cov(x, rowvar=False))
    if variances[-1] <= 1e-12:
        raise DecoyError("the embeddings to fit hardly differ from each other")
    return np.ascontiguousarray(vectors[:, ::-1])


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
    """Log likelihood of people who are not in the fit, by the sample's share: (len(SHARES),)."""
    variances, axes = np.linalg.eigh(_prior(faces, fitted))
    variances = np.maximum(variances, _FLOOR * variances[-1])
    whitening = axes / np.sqrt(variances)
    ratios, turn = np.linalg.eigh(whitening.T @ np.cov(fitted, rowvar=False) @ whitening)
    squares = np.sum(((unseen - fitted.mean(axis=0)) @ whitening @ turn) ** 2, axis=0)
    scores = []
    for share in SHARES:
        mixed = 1 - share + share * np.maximum(ratios, 0.0)
        scores.append(-0.5 * (len(unseen) * np.log(mixed).sum() + np.sum(squares / mixed)))
    return np.asarray(scores)


def _prior(faces: Array, sample: Array) -> Array:
    """Covariance (n, n) of the weighted faces, its variance in every band as in the sample."""
    odds = np.clip(TRUST * _log_odds(faces, sample), -_LARGEST_LOG_ODDS, _LARGEST_LOG_ODDS)
    weights = np.exp(odds) / np.exp(odds).sum()
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


def _log_odds(faces: Array, sample: Array) -> Array:
    """Log odds (N,) of each face to be of the sample's kind, less a constant.

    The leading coordinates tell whom a photo shows; the energies of bands, how well.
    """
    rows = np.vstack([faces, sample]) - faces.mean(axis=0)
    rows = rows / np.maximum(faces.std(axis=0), 1e-12)
    starts = np.arange(0, rows.shape[1], 2 * BAND)
    energies = np.log(np.maximum(np.add.reduceat(rows**2, starts, axis=1), 1e-8))
    features = np.hstack([rows[:, : max(2, rows.shape[1] // 8)], energies, energies**2])
    features = (features - features.mean(axis=0)) / np.maximum(features.std(axis=0), 1e-12)
    truth = np.arange(len(rows)) >= len(faces)
    return np.asarray(features[: len(faces)] @ separating_direction(features, truth))


def separating_direction(features: Array, truth: NDArray[np.bool_]) -> Array:
    """Weights (q,) of the ridge logistic regression in which both classes count the same.

    By Newton's method: K. Murphy, "Machine Learning", 2012, section 8.3.4.
    """
    rows = np.hstack([features, np.ones((len(features), 1))])
    counts = np.where(truth, 0.5 / truth.mean(), 0.5 / (1 - truth.mean()))
    ridge = np.append(np.full(features.shape[1], _RIDGE), 1e-6)
    weights = np.zeros(rows.shape[1])
    for _ in range(_NEWTON_STEPS):
        odds = 1 / (1 + np.exp(-np.clip(rows @ weights, -30.0, 30.0)))
        gradient = rows.T @ (counts * (odds - truth)) + ridge * weights
        curvature = (rows * (counts * odds * (1 - odds))[:, None]).T @ rows + np.diag(ridge)
        step = np.linalg.solve(curvature, gradient)
        weights = weights - step
        if np.abs(step).max() < 1e-6:
            break
    return weights[:-1]
