import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.population import ENROLLED_PHOTOS, draw_population
from attacks.system import raw_thresholds


def faces(
    people: int, *, several: int, photos: int = 4, n: int = 16
) -> tuple[np.ndarray, list[str]]:
    """Photos of which every number is the person's and the photo's, to be told apart."""
    rng = np.random.default_rng(0)
    names = [f"p{i}" for i in range(people) for _ in range(photos if i < several else 1)]
    rows = rng.standard_normal((len(names), n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True), names


def owner_of(rows: np.ndarray, names: list[str], wanted: np.ndarray) -> list[str]:
    return [names[int(np.argmax(rows @ row))] for row in wanted]


def test_nobody_plays_two_parts_and_the_fresh_photo_is_not_enrolled() -> None:
    rows, names = faces(700, several=200)
    population = draw_population(rows.astype(np.float32), names, victims=60, owners=100, seed=3)
    victims = owner_of(rows, names, population.victims.fresh)
    owners = owner_of(rows, names, population.owners.fresh)
    attackers = owner_of(rows, names, population.attacker)
    parts = [set(victims), set(owners), set(attackers), set(population.names)]
    assert [len(part) for part in parts] == [60, 100, 180, 360]
    assert len(set.union(*parts)) == sum(len(part) for part in parts)
    assert owner_of(rows, names, population.calibration) == list(population.names)
    for row, person in enumerate(victims):
        mine = rows[[i for i, name in enumerate(names) if name == person]]
        fresh = int(np.argmax(mine @ population.victims.fresh[row]))
        others = [
            subset for subset in [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)] if fresh not in subset
        ]
        assert int(population.victims.photos[row]) == ENROLLED_PHOTOS
        mean = mine[list(others[0])].mean(axis=0)
        assert population.victims.enrolled[row] @ mean / np.linalg.norm(mean) == pytest.approx(
            1, abs=1e-6
        )
    for row, person in enumerate(owners):
        assert owner_of(rows, names, population.owners.enrolled[row : row + 1]) == [person]
        assert population.owners.enrolled[row] @ population.owners.fresh[row] < 0.999


def test_a_seed_gives_the_same_cast() -> None:
    rows, names = faces(600, several=150)
    first, again, other = (
        draw_population(rows, names, victims=40, owners=60, seed=seed) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.victims.enrolled, again.victims.enrolled)
    assert first.names == again.names
    assert not np.array_equal(first.victims.enrolled, other.victims.enrolled)


@pytest.mark.parametrize(
    ("victims", "owners", "said"),
    [(100, 101, "people with two"), (190, 10, "left to calibrate")],
)
def test_too_few_people_are_refused(victims: int, owners: int, said: str) -> None:
    rows, names = faces(300, several=200, photos=2)
    with pytest.raises(AuditError, match=said):
        draw_population(rows, names, victims=victims, owners=owners, seed=0)


def test_raw_thresholds_are_those_of_all_pairs_of_two_people(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("attacks.system._TILE", 7)
    rows, names = faces(60, several=20)
    rows = rows.astype(np.float32)
    targets = {"a": 0.1, "b": 0.004}
    found = raw_thresholds(rows, tuple(names), targets)
    cosines = rows.astype(np.float64) @ rows.T
    apart = [
        cosines[i, j]
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if names[i] != names[j]
    ]
    for level, target in targets.items():
        reached = np.mean(np.array(apart) >= found[level])
        assert reached <= target < reached + 2 / len(apart)
