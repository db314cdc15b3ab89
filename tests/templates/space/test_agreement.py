"""The weakest split of a set of photos, against every split written out, and their mean."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from templates.space.agreement import (
    InconsistentImages,
    WeakestSplit,
    mean_embedding,
    weakest_split,
)
from tests.verify.synthetic import unit


def brute_force(rows: NDArray[np.float64]) -> WeakestSplit:
    found = []
    everybody = set(range(len(rows)))
    for size in range(1, len(rows) // 2 + 1):
        for apart in itertools.combinations(range(len(rows)), size):
            others = tuple(sorted(everybody - set(apart)))
            if size == 1:
                mean = rows[list(others)].mean(axis=0)
                agreement = float(rows[apart[0]] @ mean / np.linalg.norm(mean))
            else:
                agreement = float(
                    np.mean([rows[i] @ rows[j] for i, j in itertools.product(apart, others)])
                )
            found.append(WeakestSplit(agreement, apart, others))
    return min(found, key=lambda split: split.agreement)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7, 10])
@pytest.mark.parametrize("seed", range(5))
def test_every_split_is_looked_at(count: int, seed: int) -> None:
    rows = unit(np.random.default_rng([count, seed]).normal(size=(count, 12)) + 0.4)
    expected, found = brute_force(rows.astype(np.float64)), weakest_split(rows)
    assert found.agreement == pytest.approx(expected.agreement, abs=1e-6)
    assert {found.apart, found.others} == {expected.apart, expected.others}
    assert len(found.apart) <= len(found.others)


def test_photos_that_cancel_do_not_divide_by_nothing() -> None:
    row = np.eye(8)[0]
    assert np.isfinite(weakest_split(np.stack([row, -row, np.eye(8)[1]])).agreement)


def test_one_photo_has_no_split() -> None:
    with pytest.raises(ValueError, match="two"):
        weakest_split(np.eye(8)[:1])


@settings(max_examples=30)
@given(st.integers(1, 5), st.integers(0, 10**6), st.floats(-0.5, 0.99))
def test_photos_are_refused_by_their_weakest_split(count: int, seed: int, limit: float) -> None:
    rows = unit(np.random.default_rng(seed).normal(size=(count, 8)) + 0.7)
    if count > 1 and weakest_split(rows).agreement < limit:
        with pytest.raises(InconsistentImages) as caught:
            mean_embedding(rows, consistency=limit)
        apart, others = weakest_split(rows)[1:]
        assert (caught.value.apart, caught.value.others) == (apart, others)
    else:
        mean = rows.astype(np.float64).sum(axis=0)
        expected = mean / np.linalg.norm(mean)
        np.testing.assert_allclose(mean_embedding(rows, consistency=limit), expected, atol=1e-6)


def test_the_refusal_speaks_of_photos_by_name_or_counts_from_one() -> None:
    two = InconsistentImages((1,), (0,))
    assert two.photos == (0, 1)
    assert two.sentence().startswith("photos 1 and 2 do not look like the same person;")
    one = InconsistentImages((2,), (0, 1, 3))
    assert one.sentence().startswith("photo 3 does not look like the person on photos 1, 2 and 4;")
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    assert one.sentence(names).startswith(
        "c.jpg does not look like the person on a.jpg, b.jpg and d.jpg;"
    )
    halves = InconsistentImages((1, 2), (0, 3))
    assert halves.sentence().startswith("photos 2 and 3 do not look like the person on photos 1 ")


def test_a_photo_given_twice_counts_once_and_keeps_its_position() -> None:
    one, near, other = unit(np.array([[1.0, 0.0, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(
        mean_embedding(np.stack([one, one, near, one]), consistency=0.5),
        mean_embedding(np.stack([one, near]), consistency=0.5),
    )
    with pytest.raises(InconsistentImages, match="photos 1 and 3 do not look") as caught:
        mean_embedding(np.stack([one, one, other]), consistency=0.5)
    assert caught.value.photos == (0, 2)


def test_photos_that_cancel_are_inconsistent_at_any_limit() -> None:
    opposite = unit(np.array([[3.0, 4.0], [-3.0, -4.0]]))
    with pytest.raises(InconsistentImages):
        mean_embedding(opposite, consistency=-1.0)
