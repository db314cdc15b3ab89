import numpy as np
import pytest

from templates.contract.expectation import PointExpectation
from templates.contract.nobody import COHORT_SIZE, Nobody
from templates.decoys import NOISE_ENERGY, DecoyGenerator
from templates.distances import Metric
from templates.errors import ContractError, DecoyError
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

N, M = 16, 4


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def nobody() -> Nobody:
    rng = np.random.default_rng(0)
    people = unit(rng.normal(size=(300, N)))
    return Nobody.of(people, DecoyGenerator.fit(people), seed=bytes(range(32)))


@pytest.fixture(scope="module")
def expectation() -> PointExpectation:
    return PointExpectation(
        metric=Metric.SPHERICAL,
        projector=np.eye(N, dtype=np.float32) * np.float32(M / N),
        foot=np.full(N, 0.05, dtype=np.float32),
        mean=np.array([0.9, 0, 0, 0, 1.0, 0.01]),
        log_spread=np.array([0, 0, 0, 0, 0.2, np.log(0.1)]),
    )


def test_the_score_is_a_tilted_mean(nobody: Nobody, expectation: PointExpectation) -> None:
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
    along = people @ np.full(N, 0.05)
    means, spreads = 0.9 * np.sqrt(M / N) + along + 0.01, 0.1 * np.exp(0.2 * along)
    z = (people @ foot + radius * np.linalg.norm(people @ basis.T, axis=1) - means) / spreads
    score = nobody.score(template, expectation)
    assert score == pytest.approx(np.log(np.mean(np.exp(2 * z))) / 2, rel=1e-3)
    # Chernoff's bound, for every threshold.
    assert all(np.mean(z > a) <= np.exp(2 * (score - a)) + 1e-9 for a in np.linspace(-3, 9, 50))
    both = SubspaceBatch.of([template, template])
    half = nobody.scores(both, expectation, rows=slice(150))
    assert half == pytest.approx(np.log(np.mean(np.exp(2 * z[:150]))) / 2, rel=1e-3)


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


@pytest.mark.parametrize("count", [300, 1000])
def test_the_cohort_is_a_function_of_the_seed_alone(count: int) -> None:
    people = unit(np.random.default_rng(1).normal(size=(count, N)))
    generator = DecoyGenerator.fit(people)
    first, again, other = (
        Nobody.of(people, generator, seed=bytes([seed]) * 32).cohort(
            strategy=Strategy.ADVERSARIAL, m=M
        )
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.numbers, again.numbers)
    assert np.abs(first.restored().bases - other.restored().bases).max() > 0.1
    assert (len(first), first.m) == (min(count, COHORT_SIZE), M)
    # Each hides another stranger, and from all of them, whatever order they have.
    inside = [
        np.flatnonzero(np.linalg.norm(people - each.project(people), axis=1) < 1e-2).tolist()
        for each in first.restored()
    ]
    assert all(len(owners) == 1 for owners in inside)
    owners = sorted(owner for (owner,) in inside)
    assert len(set(owners)) == len(owners)
    assert owners[-1] >= count - 3


def test_templates_of_nobody_have_the_noise_of_stored_ones() -> None:
    """Along axes on which people do not vary, their spans hold noise and nothing else."""
    scale = np.where(np.arange(N) < 3 * N // 4, 1.0, 1e-3)
    people = unit(np.random.default_rng(3).normal(size=(300, N)) * scale)
    quiet = slice(3 * N // 4, N)
    energies = {}
    for noise in (0.0, NOISE_ENERGY / N):
        generator = DecoyGenerator.fit(people, noise=noise)
        kept = Nobody.of(people, generator, seed=bytes(range(32)))
        read = Nobody.from_tensors(kept.tensors())
        assert read.generator.noise == noise
        assert read.digest == kept.digest
        with Keystream.seeded("stand-ins") as stream:
            stand_ins = [
                read.lift(strategy=Strategy.ADVERSARIAL, m=M, stream=stream) for _ in range(50)
            ]
            stored = lift(
                people[:50], strategy=Strategy.ADVERSARIAL, m=M, source=generator, stream=stream
            )
        cohort = read.cohort(strategy=Strategy.ADVERSARIAL, m=M)
        energies[noise] = [
            np.mean([np.sum(template.basis[:, quiet] ** 2) for template in templates])
            for templates in (stand_ins, cohort.restored(), stored)
        ]
    assert max(energies[0.0]) < 1e-3
    # Rounding takes nothing from them, however little they are.
    assert energies[0.0][1] == pytest.approx(energies[0.0][2], rel=0.15)
    stand_ins, cohort, stored = energies[NOISE_ENERGY / N]
    assert stand_ins == pytest.approx(stored, rel=0.15)
    assert cohort == pytest.approx(stored, rel=0.15)
    assert stored > 0.01


@pytest.mark.parametrize(
    "noise", [np.array([np.nan]), np.array([-1.0]), np.array([0.2]), np.zeros(2), np.zeros(0)]
)
def test_strangers_with_impossible_noise_are_refused(nobody: Nobody, noise: np.ndarray) -> None:
    with pytest.raises((ContractError, DecoyError)):
        Nobody.from_tensors({**nobody.tensors(), "noise": noise})
