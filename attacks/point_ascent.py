"""Gradient ascent with raw probes on the decision: wolves among embeddings.

A probe climbs the mean over templates of σ(z − threshold), where z is its score: a smooth form of
the share of templates that accept.
"""

import numpy as np
from numpy.typing import NDArray

from templates.contract.nobody import Nobody
from templates.distances import Metric
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Array64 = NDArray[np.float64]

ROUNDS = 60
_FIRST_STEP, _LAST_STEP = 0.3, 0.01
"""Length of a step, in radians; directions of steps are normalised."""
_ASIDE = 1e-3


def ascend_points(
    starts: Array32, targets: SubspaceBatch, nobody: Nobody, *, threshold: float
) -> Array32:
    """Climb: unit rows (S, k) to unit rows (S, k), by the spherical metric."""
    points = normalised(starts.astype(np.float32))
    best, best_value = points, np.full(len(points), -np.inf)
    for step in step_lengths(ROUNDS):
        value, further = _climb_once(points, targets, nobody, threshold=threshold, step=step)
        best = np.where((value > best_value)[:, None], points, best)
        best_value = np.maximum(value, best_value)
        points = further
    return np.ascontiguousarray(best, dtype=np.float32)


def _climb_once(
    points: Array32, targets: SubspaceBatch, nobody: Nobody, *, threshold: float, step: float
) -> tuple[Array64, Array32]:
    """Return the objective at unit rows (S, k), (S,), and the rows a step uphill, in radians."""
    rows = targets.bases.reshape(-1, targets.n)
    radii = targets.radii.astype(np.float32)
    inside = (points @ rows.T).reshape(len(points), len(targets), -1)
    lengths = np.maximum(np.linalg.norm(inside, axis=2), 1e-6)
    similarities = points @ targets.feet.T + radii * lengths
    means, spreads = nobody.statistics(points, Metric.SPHERICAL)
    score = (similarities.astype(np.float64) - means[:, None]) / spreads[:, None]
    value, by_score = accepted_share(score, threshold)
    by_similarity = by_score / spreads[:, None]
    weights = by_similarity.astype(np.float32)
    inside *= (weights * radii / lengths)[:, :, None]
    gradient = weights @ targets.feet + inside.reshape(len(points), -1) @ rows
    by_mean, by_spread = -by_similarity.sum(axis=1), -(by_score * score).sum(axis=1)
    mean_slopes, spread_slopes = _expected_slopes(points, nobody)
    gradient += (by_mean[:, None] * mean_slopes + by_spread[:, None] * spread_slopes).astype(
        np.float32
    )
    gradient -= np.einsum("si,si->s", gradient, points)[:, None] * points
    return value, normalised((points + step * normalised(gradient)).astype(np.float32))


def _expected_slopes(points: Array32, nobody: Nobody) -> tuple[Array64, Array64]:
    """Gradients of the expected mean and of the log spread, each (S, k), by differences."""
    count, k = points.shape
    moved = points[:, None].astype(np.float64) + _ASIDE * np.eye(k)
    back = points[:, None].astype(np.float64) - _ASIDE * np.eye(k)
    ahead = nobody.statistics(moved.reshape(-1, k), Metric.SPHERICAL)
    behind = nobody.statistics(back.reshape(-1, k), Metric.SPHERICAL)
    mean = (ahead[0] - behind[0]) / (2 * _ASIDE)
    spread = (np.log(ahead[1]) - np.log(behind[1])) / (2 * _ASIDE)
    return mean.reshape(count, k), spread.reshape(count, k)


def accepted_share(scores: Array64, threshold: float) -> tuple[Array64, Array64]:
    """Mean over the templates of σ(z − threshold), (S,), and its slope by every z, (S, T)."""
    accepted = 1 / (1 + np.exp(-np.clip(scores - threshold, -60, 60)))
    return accepted.mean(axis=1), accepted * (1 - accepted) / scores.shape[1]


def step_lengths(rounds: int) -> list[float]:
    """Lengths of the steps of an ascent, falling."""
    return [float(step) for step in np.geomspace(_FIRST_STEP, _LAST_STEP, rounds)]
