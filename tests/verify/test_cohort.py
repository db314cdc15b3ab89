"""The cohort stands for the templates that a probe meets, not for the decoys."""

import gc
import weakref

import numpy as np
import pytest

from templates.decoys import DecoyGenerator
from templates.distances import Metric, pairwise_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy
from templates.space.subspace import SubspaceBatch
from verify.cohort import cohort_statistics, make_cohort, people_like, rounded_cohort

N, M = 32, 4


def around(axis: int, count: int, seed: int) -> np.ndarray:
    """Unit vectors that lean towards one coordinate axis."""
    rows = np.random.default_rng(seed).standard_normal((count, N)) * 0.4
    rows[:, axis] += 1.5
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def others() -> DecoyGenerator:
    """Decoys of another population than the people's."""
    return DecoyGenerator.fit(around(1, 600, seed=1))


def cohort(source: DecoyGenerator, people: np.ndarray | None) -> SubspaceBatch:
    with Keystream.seeded("cohort") as stream:
        return make_cohort(
            source, strategy=Strategy.ADVERSARIAL, m=M, stream=stream, size=200,
            hidden=people_like(source, people),
        )  # fmt: skip


def nearness(templates: SubspaceBatch, probes: np.ndarray) -> float:
    distances = pairwise_distances(probes, templates, metric=Metric.SPHERICAL, steps=50)
    return float(np.mean(similarity(distances)))


def test_the_cohort_is_spread_like_the_people(others: DecoyGenerator) -> None:
    strangers = around(0, 100, seed=3)
    fitted = cohort(others, around(0, 600, seed=2))
    unfitted = cohort(others, None)
    assert nearness(fitted, strangers) > nearness(unfitted, strangers) + 0.1
    assert (fitted.n, fitted.m, len(fitted)) == (N, M, 200)


def test_nobody_of_the_people_is_in_the_cohort(others: DecoyGenerator) -> None:
    people = around(0, 600, seed=2)
    distances = pairwise_distances(
        people, cohort(others, people), metric=Metric.SPHERICAL, steps=50
    )
    assert distances.min() > 1e-3


def test_too_few_people_leave_the_cohort_to_the_decoys(others: DecoyGenerator) -> None:
    few = cohort(others, around(0, N - 1, seed=2))
    np.testing.assert_array_equal(few.bases, cohort(others, None).bases)


@pytest.mark.parametrize("metric", Metric)
def test_the_rounded_cohort_tells_points_what_the_exact_one_would(
    others: DecoyGenerator, metric: Metric
) -> None:
    templates, strangers = cohort(others, None), around(0, 50, seed=3)
    means, spreads = cohort_statistics(strangers, templates, metric=metric, steps=50)
    distances = pairwise_distances(strangers, templates, metric=metric, dtype=np.float64)
    exact = np.asarray(similarity(distances))
    np.testing.assert_allclose(means, exact.mean(axis=1), atol=2e-4)
    np.testing.assert_allclose(spreads, exact.std(axis=1, ddof=1), rtol=5e-3)


def test_a_cohort_is_rounded_once_and_forgotten_with_its_templates(others: DecoyGenerator) -> None:
    templates = cohort(others, None)
    kept = weakref.ref(rounded_cohort(templates))
    assert rounded_cohort(templates) is kept()
    del templates
    gc.collect()
    assert kept() is None
