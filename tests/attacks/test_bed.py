import numpy as np
import pytest

from attacks.bed import Pairs
from attacks.operating_point import thieves
from attacks.outcomes import AuditError
from attacks.population import ENROLLED_PHOTOS, draw_population
from attacks.recovery import Recovery
from attacks.setup import MEANS, ONE_PHOTO, PHOTOS, AttackSetup, face_counts
from attacks.stored.second_moments import SPHERE_SHARES
from templates.errors import DecoyError
from templates.space.lifting import Strategy
from tests.attacks.kinds import FACES, OTHER, N, generator, rows
from tests.verify.synthetic import make_pool, unit


def setup_with(kind: np.ndarray, *, shuffled: bool = False) -> AttackSetup:
    """Two photos of each of 120 people, 1,500 other faces, and a generator of a kind."""
    enrolled = rows(120, FACES, 1)
    fresh = unit(enrolled + 0.6 * rows(120, FACES, 2)).astype(np.float32)
    victims = Pairs(enrolled, np.roll(fresh, 1, axis=0) if shuffled else fresh)
    return AttackSetup.of(victims, rows(1_500, FACES, 3), generator(tuple(kind)))


def best(thefts: list[Recovery], *, drawn: bool = False) -> Recovery:
    return max(
        (one for one in thefts if (one.faces is None) == drawn), key=lambda one: one.matched.value
    )


@pytest.mark.parametrize("axes", [N, 40])
@pytest.mark.parametrize("strategy", [Strategy.ADVERSARIAL, Strategy.HYBRID, Strategy.RANDOM])
def test_decoys_of_another_kind_and_random_lifting_fail(axes: int, strategy: Strategy) -> None:
    bed = setup_with(OTHER).bed(strategy, axes=axes, m=8)
    assert bed.victims.enrolled.shape == (120, axes)
    strongest = best(thieves(bed))
    assert strongest.matched.value > 0.7
    assert strongest.matched.trials == 120


def test_more_decoys_of_the_same_kind_hide_more() -> None:
    bed = setup_with(FACES).bed(Strategy.ADVERSARIAL, axes=N, m=2)
    few, many = (best(thieves(one)).matched for one in (bed, bed.at(20)))
    assert many.value < few.value - 0.3


def test_attackers_are_named_by_their_faces_and_how_they_count_them() -> None:
    thefts = thieves(setup_with(FACES).bed(Strategy.HYBRID, axes=N, m=4))
    named = [(one.attack, one.faces, one.to_json()["share_of_decoys"]) for one in thefts]
    assert named == [
        ("foot-point", 0, 1.0),
        *(("second-moments", faces, share) for share in SPHERE_SHARES for faces in (1_000, 1_500)),
        *(("second-moments", None, share) for share in SPHERE_SHARES),
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
        bed = setup.bed(Strategy.ADVERSARIAL, axes=N, m=12)
        assert bed.drawn is not None
        drawn = bed.drawn.victims
        seen = np.einsum("ij,ij->i", drawn.enrolled, drawn.fresh)
        real = np.einsum("ij,ij->i", setup.victims.enrolled, setup.victims.fresh)
        assert np.isclose(np.sort(real)[:, None], seen, atol=1e-5).any(axis=0).all()
        found.append(best(thieves(bed), drawn=True))
    assert found[1].matched.value > found[0].matched.value + 0.2
    assert found[0].to_json()["faces"] == "unlimited, simulated"


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
    with pytest.raises(AuditError, match="fresh photo"):
        AttackSetup.of(setup.victims[:0], setup.faces, setup.source)
    with pytest.raises(DecoyError, match="have all 64 numbers"):
        make_pool().reduced(60)


def photos_of(
    people: int, *, several: int, photos: int = 4, n: int = 16
) -> tuple[np.ndarray, list[str]]:
    """Photos of which every number is the person's and the photo's, to be told apart."""
    rng = np.random.default_rng(0)
    names = [f"p{i}" for i in range(people) for _ in range(photos if i < several else 1)]
    return unit(rng.standard_normal((len(names), n))), names


def owner_of(photos: np.ndarray, names: list[str], wanted: np.ndarray) -> list[str]:
    return [names[int(np.argmax(photos @ row))] for row in wanted]


def test_nobody_plays_two_parts_and_the_fresh_photo_is_not_enrolled() -> None:
    photos, names = photos_of(700, several=200)
    population = draw_population(photos, names, victims=60, owners=100, seed=3)
    victims = owner_of(photos, names, population.victims.fresh)
    owners = owner_of(photos, names, population.owners.fresh)
    parts = [set(victims), set(owners), set(population.names)]
    assert [len(part) for part in parts] == [60, 100, 540]
    assert len(set.union(*parts)) == 700
    assert owner_of(photos, names, population.others) == list(population.names)
    for row, person in enumerate(victims):
        album = photos[[name == person for name in names]]
        fresh = int(np.argmax(album @ population.victims.fresh[row]))
        enrolled = np.delete(album, fresh, axis=0)
        assert len(enrolled) == ENROLLED_PHOTOS
        mean = unit(enrolled.mean(axis=0))
        assert population.victims.enrolled[row] @ mean == pytest.approx(1, abs=1e-6)
    assert owner_of(photos, names, population.owners.enrolled) == owners
    seen = np.einsum("ij,ij->i", population.owners.enrolled, population.owners.fresh)
    assert seen.max() < 0.999
    again, other = (
        draw_population(photos, names, victims=60, owners=100, seed=seed) for seed in (3, 4)
    )
    np.testing.assert_array_equal(population.victims.enrolled, again.victims.enrolled)
    assert not np.array_equal(population.victims.enrolled, other.victims.enrolled)
