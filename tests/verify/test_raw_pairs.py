import numpy as np
import pytest

from templates.errors import ContractError
from tests.verify.synthetic import draw_people
from verify import raw_pairs
from verify.raw_pairs import impostor_cosines, suspicious_pairs


@pytest.fixture(autouse=True)
def _small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raw_pairs, "TILE", 7)


def brute_force(descriptors: np.ndarray, person_of: np.ndarray) -> list[tuple[float, int, int]]:
    return [
        (float(descriptors[i] @ descriptors[j]), int(person_of[i]), int(person_of[j]))
        for i in range(len(descriptors))
        for j in range(i + 1, len(descriptors))
        if person_of[i] != person_of[j]
    ]


def test_every_pair_of_different_people_is_compared_once() -> None:
    people = draw_people(30, n=16)
    person_of = np.unique(people.names, return_inverse=True)[1]
    found = impostor_cosines(people.descriptors, person_of, rng=np.random.default_rng(0))
    expected = [cosine for cosine, _, _ in brute_force(people.descriptors, person_of)]
    assert np.sort(found) == pytest.approx(np.sort(expected), abs=1e-6)


def test_of_many_photos_a_subset_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raw_pairs, "MOST_PHOTOS", 20)
    people = draw_people(60, photos=(1,), n=16)
    found = impostor_cosines(people.descriptors, np.arange(60), rng=np.random.default_rng(0))
    assert found.size == 20 * 19 // 2


def test_one_person_under_two_names_is_reported_first() -> None:
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
