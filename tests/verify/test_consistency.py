"""The limit on photos of one enrollment: what it refuses, and whom it lets through."""

import numpy as np
import pytest

from templates.errors import ContractError
from templates.space.agreement import weakest_split
from tests.verify.synthetic import People, draw_people
from verify import consistency
from verify.consistency import (
    Consistency,
    impostor_cosines,
    match_cosine,
    photo_consistency,
    suspicious_pairs,
)


def limit(people: People, *, photos: int = 3, seed: int = 0) -> Consistency:
    person_of = np.unique(people.names, return_inverse=True)[1]
    rng = np.random.default_rng(seed)
    return photo_consistency(people.descriptors, person_of, photos=photos, rng=rng)


def test_genuine_sets_of_new_people_are_refused_as_rarely_as_it_says() -> None:
    people = draw_people(400, n=256, photos=(5,), noise=1.5, seed=1)
    found = limit(people)
    others = draw_people(400, n=256, photos=(3,), noise=1.5, seed=2).descriptors
    others = others.reshape(400, 3, 256)
    refused = np.mean([weakest_split(rows).agreement < found.threshold for rows in others])
    assert found.refused.trials == 4000
    assert found.refused.value <= 0.02
    assert refused <= 0.04
    lax = match_cosine(people.descriptors, people.names)
    assert lax < found.threshold
    assert found.probe_threshold == pytest.approx(lax, abs=1e-6)


def test_mislabelled_photos_do_not_lower_it_below_what_strangers_reach() -> None:
    people = draw_people(200, photos=(3,), noise=0.5, seed=3)
    mislabelled = People(people.descriptors.copy(), people.names)
    wrong = np.arange(0, 60, 3)  # of 20 people, a tenth
    mislabelled.descriptors[wrong] = people.descriptors[wrong + 300]
    assert limit(people).threshold > limit(mislabelled).threshold
    lax = match_cosine(mislabelled.descriptors, mislabelled.names)
    assert limit(mislabelled).threshold == pytest.approx(lax)


@pytest.fixture
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(consistency, "TILE", 7)


def brute_force(descriptors: np.ndarray, person_of: np.ndarray) -> list[tuple[float, int, int]]:
    return [
        (float(descriptors[i] @ descriptors[j]), int(person_of[i]), int(person_of[j]))
        for i in range(len(descriptors))
        for j in range(i + 1, len(descriptors))
        if person_of[i] != person_of[j]
    ]


def test_every_pair_of_different_people_is_compared_once(small_tiles: None) -> None:
    people = draw_people(30, n=16)
    person_of = np.unique(people.names, return_inverse=True)[1]
    found = impostor_cosines(people.descriptors, person_of, rng=np.random.default_rng(0))
    expected = [cosine for cosine, _, _ in brute_force(people.descriptors, person_of)]
    assert np.sort(found) == pytest.approx(np.sort(expected), abs=1e-6)


def test_one_person_under_two_names_is_reported_first(small_tiles: None) -> None:
    people = draw_people(40, photos=(2,), noise=0.3)
    names = [*people.names, "second name"]
    descriptors = np.concatenate([people.descriptors, people.descriptors[6:7]])
    found, person_of = np.unique(names, return_inverse=True)
    suspicious = suspicious_pairs(descriptors, person_of, list(found), above=0.6)
    expected = {
        frozenset((a, b)) for cosine, a, b in brute_force(descriptors, person_of) if cosine >= 0.6
    }
    assert {pair.first for pair in suspicious[:1]} | {pair.second for pair in suspicious[:1]} == {
        names[6],
        "second name",
    }
    assert suspicious[0].cosine == pytest.approx(1.0, abs=1e-3)
    assert len(suspicious) == len(expected)


def test_a_single_person_gives_no_pair() -> None:
    people = draw_people(1, photos=(5,))
    with pytest.raises(ContractError, match="two people"):
        impostor_cosines(
            people.descriptors, np.zeros(5, dtype=np.int64), rng=np.random.default_rng(0)
        )
