"""Closed forms of templates of nobody, held against templates that are lifted."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from templates.contract.nobody import COHORT_SIZE, Nobody
from templates.decoys import DecoyGenerator
from templates.distances import Metric, pairwise_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

K, M, TEMPLATES = 96, 34, 400
STRATEGIES = [Strategy.ADVERSARIAL, Strategy.HYBRID, Strategy.RANDOM]


def generator() -> DecoyGenerator:
    """Decoys with a mean and a steep spectrum, as those of faces have."""
    mean = np.zeros(K)
    mean[:3] = (0.2, -0.1, 0.05)
    return DecoyGenerator(np.eye(K), mean, np.diag(0.2 * 0.97 ** np.arange(K)))


def nobody(strategy: Strategy = Strategy.ADVERSARIAL, *, seed: int = 0) -> Nobody:
    return Nobody(generator(), strategy, M, bytes([seed]) * 32)


def templates(strategy: Strategy) -> SubspaceBatch:
    stream = Keystream.seeded("templates of nobody", strategy)
    points = generator().draw(TEMPLATES, 1, stream=stream)[:, 0]
    return lift(points, strategy=strategy, m=M, source=generator(), stream=stream)


@pytest.mark.parametrize("metric", list(Metric))
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_mean_and_spread_are_those_of_lifted_templates(strategy: Strategy, metric: Metric) -> None:
    """For people, who are drawn, and for wolves: axes and the mean."""
    stream = Keystream.seeded("people")
    people = generator().draw(60, 1, stream=stream)[:, 0]
    mean = generator().mean / np.linalg.norm(generator().mean)
    probes = np.concatenate([people, np.eye(K)[:10], mean[None]]).astype(np.float32)
    close = np.asarray(
        similarity(pairwise_distances(probes, templates(strategy), metric=metric)), np.float64
    )
    means, spreads = nobody(strategy).statistics(probes, metric)
    seen = close.std(axis=1, ddof=1)
    # The mean of 400 similarities is off by a twentieth of their spread, and rarely by more than
    # four times that; the form itself by up to a tenth.
    assert np.abs((close.mean(axis=1) - means) / seen).max() < 0.4
    assert np.sqrt(np.mean(((close.mean(axis=1) - means) / seen) ** 2)) < 0.15
    # Of directions that are drawn and not fitted, the form takes the foot point as Gaussian.
    off = {Strategy.ADVERSARIAL: 0.08, Strategy.HYBRID: 0.15, Strategy.RANDOM: 0.15}[strategy]
    assert np.mean(spreads / seen) == pytest.approx(1, abs=off)
    np.testing.assert_allclose(spreads / seen, 1, atol=0.4)


def test_a_wolf_expects_more_than_people() -> None:
    stream = Keystream.seeded("people")
    people = generator().draw(60, 1, stream=stream)[:, 0]
    means, _ = nobody().statistics(people, Metric.SPHERICAL)
    wolf, _ = nobody().statistics(np.eye(K, dtype=np.float32)[:1], Metric.SPHERICAL)
    assert wolf[0] > means.max()


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_similarity_to_strangers_is_that_of_drawn_people(strategy: Strategy) -> None:
    stream = Keystream.seeded("strangers")
    people = generator().draw(4000, 1, stream=stream)[:, 0]
    some = templates(strategy)[:20]
    close = similarity(pairwise_distances(people, some, metric=Metric.SPHERICAL)).mean(axis=0)
    np.testing.assert_allclose(nobody(strategy).stranger_similarity(some), close, atol=0.02)


def test_a_template_of_leading_axes_is_nearer_to_strangers_than_any_lifted_one() -> None:
    honest = nobody().stranger_similarity(templates(Strategy.ADVERSARIAL))
    limit = honest.mean() + 6 * honest.std()
    foot = 0.1 * np.eye(K, dtype=np.float32)[-1]
    wolf = SubspaceBatch(foot, np.eye(K, dtype=np.float32)[:M])
    assert nobody().stranger_similarity(SubspaceBatch.of([wolf]))[0] > limit
    assert honest.max() < limit


def test_the_cohort_follows_the_seed_and_is_lifted_once() -> None:
    """From Python 3.12 on a cached property has no lock of its own."""
    own = nobody()
    with ThreadPoolExecutor(4) as pool:
        seen = list(pool.map(lambda _: own.cohort, range(4)))
    assert all(cohort is seen[0] for cohort in seen)
    assert len(own.cohort) == COHORT_SIZE
    np.testing.assert_array_equal(nobody().cohort.feet, own.cohort.feet)
    assert not np.allclose(nobody(seed=1).cohort.feet, own.cohort.feet)
    one = own.lift(Keystream.seeded("one"))
    assert (one.n, one.m) == (K, M)
