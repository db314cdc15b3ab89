import numpy as np
import pytest

from templates.contract.nobody import Nobody
from templates.decoys import DecoyGenerator
from templates.distances import Metric
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift

N, M = 16, 4


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def nobody() -> Nobody:
    rng = np.random.default_rng(0)
    people = unit(rng.normal(size=(300, N)))
    means = rng.uniform(0.4, 0.5, 300).astype(np.float32)
    spreads = rng.uniform(0.05, 0.1, 300).astype(np.float32)
    return Nobody(people, means, spreads, DecoyGenerator.fit(people))


def test_the_score_is_a_tilted_mean(nobody: Nobody) -> None:
    with Keystream.seeded("client") as stream:
        template = lift(
            nobody.people[:1],
            strategy=Strategy.ADVERSARIAL,
            m=M,
            source=nobody.generator,
            stream=stream,
        )[0]
    foot, basis = template.foot.astype(np.float64), template.basis.astype(np.float64)
    people = nobody.people.astype(np.float64)
    radius = np.sqrt(1 - foot @ foot)
    z = (people @ foot + radius * np.linalg.norm(people @ basis.T, axis=1) - nobody.means) / (
        nobody.spreads
    )
    score = nobody.score(template, metric=Metric.SPHERICAL, steps=50)
    assert score == pytest.approx(np.log(np.mean(np.exp(2 * z))) / 2, rel=1e-3)
    # Chernoff's bound, for every threshold.
    assert all(np.mean(z > a) <= np.exp(2 * (score - a)) + 1e-9 for a in np.linspace(-3, 9, 50))


@pytest.mark.parametrize("strategy", [Strategy.ADVERSARIAL, Strategy.HYBRID, Strategy.RANDOM])
def test_a_template_of_nobody_is_a_lift_of_a_stranger(nobody: Nobody, strategy: Strategy) -> None:
    owners = set()
    for number in range(20):
        templates = [
            nobody.lift(strategy=strategy, m=M, stream=Keystream.seeded("digest", number))
            for _ in range(2)
        ]
        assert (templates[0].foot == templates[1].foot).all()
        assert (templates[0].basis == templates[1].basis).all()
        templates[0].validate(1e-4)
        # One stranger, and no other, lies in it.
        near = nobody.people - templates[0].project(nobody.people)
        lengths = np.linalg.norm(near, axis=1)
        assert lengths.min() < 1e-4 < 1e-2 < np.sort(lengths)[1]
        owners.add(int(lengths.argmin()))
    assert len(owners) > 10
