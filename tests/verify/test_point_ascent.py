"""Ascents on the decision: slopes against finite differences, and where they end."""

import numpy as np
import pytest

from templates.space.subspace import SubspaceBatch
from tests.verify.population import N, contract, enrolled, photos_of, templates_of, unit
from verify.point_ascent import ascend_points, expected_slopes, point_slopes


def noise(count: int, seed: int) -> np.ndarray:
    return unit(np.random.default_rng(seed).standard_normal((count, N)))


def test_the_slopes_of_what_is_expected_are_those_of_finite_differences() -> None:
    expectation = contract().expectation
    points = noise(3, 0)
    for which, slopes in enumerate(expected_slopes(points, expectation)):

        def value(rows: np.ndarray, which: int = which) -> np.ndarray:
            statistics = expectation.statistics(rows)
            return statistics[0] if which == 0 else np.log(statistics[1])

        for direction in noise(4, 1).astype(np.float64):
            across = direction - (points @ direction)[:, None] * points
            ahead, behind = (
                value(points.astype(np.float64) + sign * 1e-3 * across) for sign in (1, -1)
            )
            expected = np.einsum("si,si->s", slopes, across)
            np.testing.assert_allclose((ahead - behind) / 2e-3, expected, rtol=0.02, atol=0.02)


def test_the_slopes_of_the_share_are_those_of_finite_differences() -> None:
    similarities = 0.4 + 0.1 * np.random.default_rng(0).standard_normal((1, 30))
    means, spreads = np.array([0.3]), np.array([0.08])

    def objective(change: float, of: str) -> float:
        moved = similarities.copy()
        moved[0, 0] += change if of == "similarity" else 0
        mean = means + (change if of == "mean" else 0)
        spread = spreads * np.exp(change if of == "spread" else 0)
        return float(point_slopes(moved, mean, spread, threshold=2.0)[0][0])

    _, by_similarity, by_mean, by_spread = point_slopes(similarities, means, spreads, threshold=2.0)
    for of, slope in (
        ("similarity", by_similarity[0, 0]),
        ("mean", by_mean[0]),
        ("spread", by_spread[0]),
    ):
        difference = (objective(1e-5, of) - objective(-1e-5, of)) / 2e-5
        assert difference == pytest.approx(slope, rel=1e-3, abs=1e-8)


def test_what_is_gained_on_templates_is_hardly_gained_on_others() -> None:
    expectation = contract().expectation
    threshold = contract().calibrations[0].level("fmr-1e-2").threshold
    climbed = templates_of(enrolled(200, seed=21), seed=21)
    others = templates_of(enrolled(400, seed=22), seed=22)
    starts = np.concatenate([noise(10, 3), photos_of(20, 1, seed=23)[:, 0]])
    ends = ascend_points(starts, climbed, expectation, threshold=threshold)
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), 1, atol=1e-5)

    def accepted(probes: np.ndarray, templates: SubspaceBatch) -> float:
        inside = np.einsum("tmi,si->stm", templates.bases, probes, optimize=True)
        close = probes @ templates.feet.T + templates.radii * np.linalg.norm(inside, axis=2)
        means, spreads = expectation.statistics(probes)
        return float(np.mean((close - means[:, None]) / spreads[:, None] >= threshold))

    assert accepted(ends, climbed) > 5 * accepted(starts, climbed)
    assert accepted(ends, others) < accepted(ends, climbed) / 3
