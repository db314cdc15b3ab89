"""The weakest split of a set of photos, against every split written out."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from templates.space.agreement import WeakestSplit, weakest_split
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


def test_two_photos_agree_by_their_cosine() -> None:
    rows = unit(np.random.default_rng(0).normal(size=(2, 12)))
    assert weakest_split(rows).agreement == pytest.approx(float(rows[0] @ rows[1]), abs=1e-6)


def test_photos_that_cancel_do_not_divide_by_nothing() -> None:
    row = np.eye(8)[0]
    assert np.isfinite(weakest_split(np.stack([row, -row, np.eye(8)[1]])).agreement)


def test_one_photo_has_no_split() -> None:
    with pytest.raises(ValueError, match="two"):
        weakest_split(np.eye(8)[:1])
