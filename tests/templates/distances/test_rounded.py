"""Subspaces with rows of eight bits."""

import numpy as np
import pytest

from templates.distances import Metric, pairwise_distances, similarity
from templates.distances.kernels.lanes import LANES
from templates.distances.rounded import RoundedSubspaces
from templates.errors import InvalidEmbedding
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch

SHAPES = [(1, 1, 2), (16, 3, 33), (17, 8, 64), (40, 64, 512)]


def drawn(count: int, m: int, n: int) -> tuple[SubspaceBatch, np.ndarray]:
    rng = np.random.default_rng([count, m, n])
    rows = rng.normal(size=(count + 9, n)) / np.sqrt(1 + np.arange(n) / 8)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    points = rows[count:].astype(np.float32)
    return lift(rows[:count], strategy="random", m=m), points


def unrounded(rounded: RoundedSubspaces, m: int, n: int) -> np.ndarray:
    """(T, m, n) float64, from the layout that the class documents."""
    rows = rounded.rows.astype(np.float64).reshape(-1, m, n, LANES)
    rows *= rounded.steps.astype(np.float64).reshape(-1, m, 1, LANES)
    return rows.transpose(0, 3, 1, 2).reshape(-1, m, n)[: len(rounded)]


@pytest.mark.parametrize(("count", "m", "n"), SHAPES)
def test_rows_are_rounded_to_the_nearest_step(count: int, m: int, n: int) -> None:
    batch, _ = drawn(count, m, n)
    rounded = RoundedSubspaces.of(batch)
    largest = np.abs(batch.bases).max(axis=2, keepdims=True).astype(np.float64)
    errors = np.abs(unrounded(rounded, m, n) - batch.bases)
    assert len(rounded) == count
    assert np.all(errors <= largest / 127 * 0.5001)
    assert rounded.rows.nbytes <= batch.bases.nbytes / 4 * (1 + LANES / count)


@pytest.mark.parametrize("metric", Metric)
@pytest.mark.parametrize(("count", "m", "n"), SHAPES)
def test_similarities_are_those_of_the_rounded_rows(
    count: int, m: int, n: int, metric: Metric
) -> None:
    batch, points = drawn(count, m, n)
    rounded = RoundedSubspaces.of(batch)
    rows, feet = unrounded(rounded, m, n), batch.feet.astype(np.float64)
    for point in points:
        exact = point.astype(np.float64)
        inside, dots = ((rows @ exact) ** 2).sum(axis=1), feet @ exact
        squares = (feet**2).sum(axis=1)
        if metric is Metric.SPHERICAL:
            expected = dots + np.sqrt((1 - squares) * inside)
        else:
            expected = 1 - (exact @ exact + squares - 2 * dots - inside) / 2
        seen = rounded.similarities(point, metric=metric)
        assert seen.dtype == np.float32
        np.testing.assert_allclose(seen, np.minimum(expected, 1), atol=2e-6)


@pytest.mark.parametrize("metric", Metric)
def test_similarities_are_near_the_exact_ones(metric: Metric) -> None:
    batch, points = drawn(*SHAPES[-1])
    exact = similarity(pairwise_distances(points, batch, metric=metric, dtype=np.float64))
    seen = [RoundedSubspaces.of(batch).similarities(point, metric=metric) for point in points]
    np.testing.assert_allclose(seen, exact, atol=3e-3)


def test_no_similarity_exceeds_one() -> None:
    batch, _ = drawn(32, 8, 64)
    rounded = RoundedSubspaces.of(batch)
    inside = batch.feet + 0.3 * batch.bases.sum(axis=1)
    inside /= np.linalg.norm(inside, axis=1, keepdims=True)
    for metric in Metric:
        for point in inside:
            assert rounded.similarities(point, metric=metric).max() <= 1


def test_the_sphere_sees_directions_only() -> None:
    batch, points = drawn(17, 8, 64)
    rounded = RoundedSubspaces.of(batch)
    unit = rounded.similarities(points[0], metric=Metric.SPHERICAL)
    for factor in (1e-3, 0.5, 7):
        seen = rounded.similarities(factor * points[0], metric=Metric.SPHERICAL)
        np.testing.assert_allclose(seen, unit, atol=1e-6)
    assert not rounded.similarities(0 * points[0], metric=Metric.SPHERICAL).any()


@pytest.mark.parametrize("metric", Metric)
def test_what_is_no_point_is_refused(metric: Metric) -> None:
    batch, points = drawn(16, 3, 33)
    rounded = RoundedSubspaces.of(batch)
    for wrong in (points, points[0, :32]):
        with pytest.raises(InvalidEmbedding, match="shape"):
            rounded.similarities(wrong, metric=metric)
    for number in (np.nan, np.inf):
        broken = points[0].copy()
        broken[5] = number
        with pytest.raises(InvalidEmbedding, match="not finite"):
            rounded.similarities(broken, metric=metric)
