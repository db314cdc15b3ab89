import functools

import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.privacy import (
    MEANS,
    ONE_PHOTO,
    PHOTOS,
    SPHERE_SHARES,
    AttackSetup,
    Pairs,
    Theft,
    all_thefts,
    face_counts,
)
from templates.decoys import DecoyGenerator
from templates.errors import DecoyError
from templates.space.lifting import Strategy
from tests.verify.synthetic import make_pool, unit

N = 48
FACES = np.linspace(1.0, 0.3, N)
OTHER = np.roll(FACES, N // 2)


def rows(count: int, deviations: np.ndarray, seed: int) -> np.ndarray:
    return unit(np.random.default_rng(seed).normal(size=(count, N)) * deviations).astype(np.float32)


@functools.cache
def generator(kind: tuple[float, ...]) -> DecoyGenerator:
    return DecoyGenerator.fit(rows(3_000, np.array(kind), 4))


def setup_with(kind: np.ndarray, *, shuffled: bool = False) -> AttackSetup:
    """Two photos of each of 120 people, 1,500 other faces, and a generator of a kind."""
    enrolled = rows(120, FACES, 1)
    fresh = unit(enrolled + 0.6 * rows(120, FACES, 2)).astype(np.float32)
    victims = Pairs(enrolled, np.roll(fresh, 1, axis=0) if shuffled else fresh)
    return AttackSetup.of(victims, rows(1_500, FACES, 3), generator(tuple(kind)))


def best(thefts: tuple[Theft, ...]) -> Theft:
    return max(thefts, key=lambda theft: theft.found.value)


@pytest.mark.parametrize("axes", [N, 40])
def test_decoys_of_another_kind_and_random_lifting_fail(axes: int) -> None:
    bed = setup_with(OTHER).along(axes)
    assert bed.victims.enrolled.shape == (120, axes)
    for strategy in (Strategy.ADVERSARIAL, Strategy.HYBRID, Strategy.RANDOM):
        strongest = best(bed.thefts(strategy, 8))
        assert strongest.found.value > 0.7, strategy
        assert strongest.found.trials == 120


def test_more_decoys_of_the_same_kind_hide_more() -> None:
    bed = setup_with(FACES).along(N)
    few, many = (best(bed.thefts(Strategy.ADVERSARIAL, m)).found for m in (2, 20))
    assert many.value < few.value - 0.3


def test_photos_of_other_people_are_matched_by_chance() -> None:
    thefts = setup_with(OTHER, shuffled=True).along(N).thefts(Strategy.ADVERSARIAL, 8)
    assert best(thefts).found.value < 0.05
    assert max(theft.control.value for theft in thefts) < 0.05


def test_attackers_are_named_by_their_faces_and_how_they_count_them() -> None:
    thefts = setup_with(FACES).along(N).thefts(Strategy.HYBRID, 4)
    named = [(theft.attack, theft.faces, theft.share) for theft in thefts]
    assert named == [
        ("foot point", 0, 1.0),
        *(("second moments", faces, share) for share in SPHERE_SHARES for faces in (1_000, 1_500)),
    ]
    assert face_counts(900) == (900,)
    assert face_counts(9_000) == (1_000, 5_000, 9_000)


def test_a_person_of_many_photos_counts_once_where_people_are_counted() -> None:
    base = setup_with(FACES)
    owners = np.r_[np.zeros(500, dtype=np.int64), np.arange(1, 1_001)]
    setup = AttackSetup.of(base.victims, rows(1_500, FACES, 3), base.source, owners=owners)
    counted = dict(setup.counted)
    assert {name: len(faces) for name, faces in counted.items()} == {
        PHOTOS: 1_500, ONE_PHOTO: 1_001, MEANS: 1_001,
    }  # fmt: skip
    many = setup.faces[setup.owners == 0][: setup.photos].mean(axis=0)
    assert np.isclose(counted[MEANS] @ many / np.linalg.norm(many), 1.0, atol=1e-5).sum() == 1


def test_an_attacker_without_limit_finds_more_where_decoys_fit_worse() -> None:
    found = []
    for kind in (FACES, OTHER):
        setup = setup_with(kind)
        drawn = setup.simulated(setup.along(N))
        assert drawn is not None
        seen = np.einsum("ij,ij->i", drawn.victims.enrolled, drawn.victims.fresh)
        real = np.einsum("ij,ij->i", setup.victims.enrolled, setup.victims.fresh)
        assert np.isclose(np.sort(real)[:, None], seen, atol=1e-5).any(axis=0).all()
        found.append(drawn.thefts(Strategy.ADVERSARIAL, 12)[1])
    assert found[1].found.value > found[0].found.value + 0.2
    assert found[0].to_json()["faces"] == "unlimited, simulated"
    assert [theft.faces for theft in all_thefts(setup, Strategy.ADVERSARIAL, axes=N, m=12)] == [
        0, 1_000, 1_500, None,
    ]  # fmt: skip


def test_of_people_splits_them_without_overlap() -> None:
    names = [f"p{i // 3}" for i in range(300)]
    photos = rows(300, FACES, 6)
    source = generator(tuple(FACES))
    setup = AttackSetup.of_people(photos, names, source, photos=3, seed=0)
    assert (len(setup.victims), len(setup.faces), len(setup.mates)) == (50, 150, 50)
    shown = {names[row] for row in np.argmax(photos @ setup.victims.fresh.T, axis=0)}
    others = {names[row] for row in np.argmax(photos @ setup.faces.T, axis=0)}
    mates = {names[row] for row in np.argmax(photos @ setup.mates.fresh.T, axis=0)}
    assert len(shown) == 50
    assert mates <= others
    assert not shown & others


def test_where_nobody_has_two_photos_the_enrolled_one_must_be_matched() -> None:
    photos = rows(300, FACES, 6)
    names = [str(i) for i in range(300)]
    setup = AttackSetup.of_people(photos, names, generator(tuple(FACES)), photos=3, seed=0)
    np.testing.assert_allclose(setup.victims.enrolled, setup.victims.fresh, atol=1e-6)
    assert (len(setup.victims), len(setup.faces), len(setup.mates)) == (150, 150, 0)


@pytest.mark.parametrize(("victims", "chosen_by"), [(80, 0), (120, 20), (600, 300)])
def test_a_verdict_has_its_hundred_victims_before_a_choice_has_any(
    victims: int, chosen_by: int
) -> None:
    people = rows(victims, FACES, 1)
    faces = rows(200, FACES, 3)
    setup = AttackSetup.of(Pairs(people, people), faces, generator(tuple(FACES)))
    choosing, judged = setup.halves()
    assert (len(choosing.victims), len(judged.victims)) == (chosen_by, victims - chosen_by)


def test_what_does_not_fit_is_refused() -> None:
    setup = setup_with(FACES)
    small = np.eye(8, dtype=np.float32)
    with pytest.raises(AuditError, match="of 48 numbers"):
        AttackSetup.of(Pairs(small, small), small, setup.source)
    with pytest.raises(AuditError, match="fresh photo"):
        AttackSetup.of(
            Pairs(setup.victims.enrolled, setup.victims.fresh[:3]), setup.faces, setup.source
        )
    with pytest.raises(DecoyError, match="have all 64 numbers"):
        make_pool().reduced(60)
