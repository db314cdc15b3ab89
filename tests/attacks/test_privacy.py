import functools

import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.privacy import (
    AttackSetup,
    SimulatedPeople,
    Theft,
    extrapolate,
    face_counts,
    privacy_of,
)
from templates.decoys import DecoyGenerator
from templates.space.lifting import Strategy
from tests.verify.synthetic import unit
from verify.metrics import rate

N = 48
COSINE = 0.6
FACES = np.linspace(1.0, 0.3, N)
OTHER = np.roll(FACES, N // 2)


def rows(count: int, deviations: np.ndarray, seed: int) -> np.ndarray:
    return unit(np.random.default_rng(seed).normal(size=(count, N)) * deviations)


@functools.cache
def generator(kind: tuple[float, ...]) -> DecoyGenerator:
    return DecoyGenerator.fit(rows(3_000, np.array(kind), 4))


def setup_with(kind: np.ndarray, *, shuffled: bool = False) -> AttackSetup:
    """Two photos of each of 120 people, 1,500 other faces, and a generator of a kind."""
    enrolled = rows(120, FACES, 1)
    fresh = unit(enrolled + 0.6 * rows(120, FACES, 2))
    return AttackSetup.of(
        enrolled,
        np.roll(fresh, 1, axis=0) if shuffled else fresh,
        rows(1_500, FACES, 3),
        generator(tuple(kind)),
        match_cosine=COSINE,
    )


@pytest.fixture(scope="module")
def of_another_kind() -> AttackSetup:
    return setup_with(OTHER)


def test_decoys_of_another_kind_and_random_lifting_fail(of_another_kind: AttackSetup) -> None:
    for strategy, m in ((Strategy.ADVERSARIAL, 8), (Strategy.RANDOM, 8)):
        privacy = privacy_of(of_another_kind, strategy=strategy, m=m)
        assert privacy.strongest.found.value > 0.9, strategy
        assert privacy.strongest.found.trials == 120


def test_more_decoys_of_the_same_kind_hide_more() -> None:
    setup = setup_with(FACES)
    few, many = (
        privacy_of(setup, strategy=Strategy.ADVERSARIAL, m=m).strongest.found for m in (2, 16)
    )
    assert many.value < few.value - 0.3


def test_photos_of_other_people_are_matched_by_chance() -> None:
    setup = setup_with(OTHER, shuffled=True)
    privacy = privacy_of(setup, strategy=Strategy.ADVERSARIAL, m=8)
    assert privacy.strongest.found.value < 0.05
    assert max(theft.control.value for theft in privacy.thefts) < 0.05


def test_attackers_are_named_by_their_faces() -> None:
    setup = setup_with(FACES)
    thefts = privacy_of(setup, strategy=Strategy.HYBRID, m=4).thefts
    named = [(theft.attack, theft.faces) for theft in thefts]
    assert named == [
        ("foot point", 0),
        ("second moments", 1_000),
        ("second moments", 1_500),
    ]
    assert face_counts(900) == (900,)
    assert face_counts(9_000) == (1_000, 5_000, 9_000)


def test_a_generator_fitted_to_few_is_worse_for_who_knows_the_people() -> None:
    """The relative error of a covariance from N faces is √(n/N), whatever the covariance is."""
    genuine = np.full(150, 0.8)
    found = {
        fitted: SimulatedPeople.draw(
            np.zeros(N), np.diag(FACES**2), genuine, fitted_to=fitted, seed=0
        ).theft(Strategy.ADVERSARIAL, 6, match_cosine=COSINE, seed=0)
        for fitted in (100, 5_000)
    }
    assert found[100].found.value > found[5_000].found.value + 0.15
    assert max(theft.control.value for theft in found.values()) < 0.05
    assert found[100].to_json()["faces"] == "unlimited, simulated"


def test_simulated_fresh_photos_are_as_near_as_real_ones() -> None:
    genuine = np.linspace(0.4, 0.9, 60)
    people = SimulatedPeople.draw(np.zeros(N), np.diag(FACES**2), genuine, fitted_to=200, seed=3)
    seen = np.einsum("ij,ij->i", people.enrolled, people.fresh)
    np.testing.assert_allclose(seen, genuine, atol=1e-5)


def test_extrapolation_continues_a_line_of_logits() -> None:
    def share(faces: float) -> float:
        return float(1 / (1 + np.exp(0.5 + 1_200 / faces)))

    trials = 1_000_000
    points = [(a, rate(round(trials * share(a)), trials)) for a in (1_000, 5_000, 20_000)]
    assert extrapolate(points) == pytest.approx(share(np.inf), abs=1e-3)
    assert extrapolate(points[:1]) is None


def test_of_people_splits_them_without_overlap() -> None:
    names = [f"p{i // 3}" for i in range(300)]
    photos = rows(300, FACES, 6)
    options = {"match_cosine": COSINE, "photos": 3, "seed": 0}
    setup = AttackSetup.of_people(photos, names, DecoyGenerator.fit(rows(500, FACES, 7)), **options)
    assert len(setup.enrolled) == 50
    ((faces, _),) = setup.attackers
    assert faces == 150
    shown = np.argmax(photos @ setup.fresh.T, axis=0)
    people = {names[row] for row in shown}
    assert len(people) == 50
    with pytest.raises(AuditError, match="two photos"):
        AttackSetup.of_people(photos, [str(i) for i in range(300)], setup.source, **options)


def test_arrays_that_do_not_fit_are_refused(of_another_kind: AttackSetup) -> None:
    source = of_another_kind.source
    with pytest.raises(AuditError, match="dimensions"):
        AttackSetup.of(
            np.eye(8, dtype=np.float32),
            np.eye(8, dtype=np.float32),
            np.eye(8, dtype=np.float32),
            source,
            match_cosine=COSINE,
        )
    with pytest.raises(AuditError, match="fresh photo"):
        AttackSetup.of(
            of_another_kind.enrolled,
            of_another_kind.fresh[:3],
            of_another_kind.fresh,
            source,
            match_cosine=COSINE,
        )


def test_the_strongest_is_the_one_that_opens_most(of_another_kind: AttackSetup) -> None:
    privacy = privacy_of(of_another_kind, strategy=Strategy.ADVERSARIAL, m=8)
    assert isinstance(privacy.strongest, Theft)
    assert privacy.strongest.found.value == max(t.found.value for t in privacy.thefts)
