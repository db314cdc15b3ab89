"""Gradient ascent with raw probes on the decision: wolves that an expectation must stand.

A probe climbs the mean over templates of σ(z − threshold), where z is its score: a smooth form of
the share of templates that accept. The calibration climbs to fit what is expected of such probes;
an audit climbs on the attacker's own templates.
"""

import numpy as np
from numpy.typing import NDArray

from templates.contract.expectation import PointExpectation
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Array64 = NDArray[np.float64]

ROUNDS = 60
_FIRST_STEP, _LAST_STEP = 0.3, 0.01
"""Length of a step, in radians; directions of steps are normalised."""


def ascend_points(
    starts: Array32,
    targets: SubspaceBatch,
    expectation: PointExpectation,
    *,
    threshold: float,
    rounds: int = ROUNDS,
) -> Array32:
    """Climb: unit rows (S, n) to unit rows (S, n), by the spherical metric."""
    points = normalised(starts.astype(np.float32))
    best, best_value = points, np.full(len(points), -np.inf)
    for step in step_lengths(rounds):
        value, further = climb_once(points, targets, expectation, threshold=threshold, step=step)
        best = np.where((value > best_value)[:, None], points, best)
        best_value = np.maximum(value, best_value)
        points = further
    return np.ascontiguousarray(best, dtype=np.float32)


def climb_once(
    points: Array32,
    targets: SubspaceBatch,
    expectation: PointExpectation,
    *,
    threshold: float,
    step: float,
) -> tuple[Array64, Array32]:
    """Return the objective at unit rows (S, n), (S,), and the rows a step uphill, in radians."""
    rows = targets.bases.reshape(-1, targets.n)
    radii = targets.radii.astype(np.float32)
    inside = (points @ rows.T).reshape(len(points), len(targets), -1)
    lengths = np.maximum(np.linalg.norm(inside, axis=2), 1e-6)
    similarities = points @ targets.feet.T + radii * lengths
    value, by_similarity, *by_expected = point_slopes(
        similarities, *expectation.statistics(points), threshold=threshold
    )
    weights = by_similarity.astype(np.float32)
    inside *= (weights * radii / lengths)[:, :, None]
    gradient = weights @ targets.feet + inside.reshape(len(points), -1) @ rows
    for by, slope in zip(by_expected, expected_slopes(points, expectation), strict=True):
        gradient += (by[:, None] * slope).astype(np.float32)
    gradient -= np.einsum("si,si->s", gradient, points)[:, None] * points
    return value, normalised((points + step * normalised(gradient)).astype(np.float32))


def point_slopes(
    similarities: Array32, means: Array64, spreads: Array64, *, threshold: float
) -> tuple[Array64, Array64, Array64, Array64]:
    """Objective, (S,), and its slopes by similarities, (S, T), mean and log spread, (S,)."""
    score = (similarities.astype(np.float64) - means[:, None]) / spreads[:, None]
    objective, by_score = accepted_share(score, threshold)
    by_similarity = by_score / spreads[:, None]
    return objective, by_similarity, -by_similarity.sum(axis=1), -(by_score * score).sum(axis=1)


def accepted_share(scores: Array64, threshold: float) -> tuple[Array64, Array64]:
    """Mean over the templates of σ(z − threshold), (S,), and its slope by every z, (S, T)."""
    accepted = 1 / (1 + np.exp(-np.clip(scores - threshold, -60, 60)))
    return accepted.mean(axis=1), accepted * (1 - accepted) / scores.shape[1]


def expected_slopes(points: Array32, expectation: PointExpectation) -> tuple[Array64, Array64]:
    """Gradients of the expected mean and of the log spread by unit points, each (S, n)."""
    rows, projector = points.astype(np.float64), expectation.projector.astype(np.float64)
    once = rows @ projector
    twice = once @ projector
    inside = np.sqrt(np.maximum(np.einsum("si,si->s", rows, once), 1e-12))[:, None]
    length = np.maximum(np.linalg.norm(once, axis=1), 1e-12)[:, None]
    by_root, by_square, by_length, by_length_square, by_foot, _one = np.stack(
        [expectation.mean, expectation.log_spread], axis=1
    )
    mean, spread = (
        (by_root[of] / inside + 2 * by_square[of]) * once
        + (by_length[of] / length + 2 * by_length_square[of]) * twice
        + by_foot[of] * expectation.foot
        for of in (0, 1)
    )
    return mean, spread


def step_lengths(rounds: int) -> list[float]:
    """Lengths of the steps of an ascent, falling."""
    return [float(step) for step in np.geomspace(_FIRST_STEP, _LAST_STEP, rounds)]
