"""Means over few templates, against those over many others."""

import numpy as np
import pytest

from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift_of_nobody
from tests.verify.population import M, N, decoys, enrolled
from verify.cohort import people_like
from verify.mean_template import MeanTemplate, Templates

FEW, MANY = 400, 10_000


def mean_template(count: int, strategy: Strategy, purpose: str) -> MeanTemplate:
    hidden = people_like(decoys(), enrolled(400, seed=2))
    with Keystream.seeded(purpose) as stream:

        def draw(size: int) -> Templates:
            points = hidden.draw(size, 1, stream=stream)[:, 0]
            return lift_of_nobody(points, strategy=strategy, m=M, source=decoys(), stream=stream)

        means = MeanTemplate.empty(N)
        for half in (0, 1):
            tiles = list(means.add(half, draw, count // 2, tile=300))
            assert sum(len(feet) for feet, _ in tiles) == count // 2
    return means


@pytest.mark.parametrize("strategy", [Strategy.ADVERSARIAL, Strategy.HYBRID, Strategy.RANDOM])
def test_an_estimate_from_few_is_nearer_than_their_mean(strategy: Strategy) -> None:
    hidden = people_like(decoys(), enrolled(400, seed=2))
    many = mean_template(MANY, strategy, "many")
    truth = many.projectors.sum(axis=0) / MANY
    foot = many.feet.sum(axis=0) / MANY
    few = mean_template(FEW, strategy, "few")
    projector, middle = few.estimate([decoys(), hidden])
    np.testing.assert_array_equal(projector, projector.T)
    assert np.trace(projector) == pytest.approx(M, rel=1e-6)
    mean = few.projectors.sum(axis=0) / FEW
    assert np.linalg.norm(projector - truth) < 0.7 * np.linalg.norm(mean - truth)
    assert np.linalg.norm(middle - foot) < np.linalg.norm(few.feet.sum(axis=0) / FEW - foot)


def test_without_generators_halves_that_agree_keep_their_mean() -> None:
    means = mean_template(FEW, Strategy.ADVERSARIAL, "few")
    means.projectors[1], means.feet[1] = means.projectors[0], means.feet[0]
    projector, foot = means.estimate([])
    np.testing.assert_allclose(projector, means.projectors[0] / (FEW / 2), atol=1e-12)
    np.testing.assert_allclose(foot, means.feet[0] / (FEW / 2), atol=1e-12)
