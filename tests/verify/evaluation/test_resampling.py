import numpy as np
import pytest

from tests.verify.evaluation.materials import material
from verify.evaluation.resampling import (
    Weights,
    draw_weights,
    fmr_grid,
    fnmr_curve,
    fnmr_replicates,
)
from verify.metrics import fnmr_at_fmr


def test_replicates_weigh_people_as_often_as_they_are_drawn() -> None:
    known = material(people=20, pairs=60)
    weights = draw_weights(known, seed=1, replicates=200)
    assert weights.interval == "subject-bootstrap"
    people = known.people
    assert people is not None
    genuine = people[known.first[known.same]]
    # Two genuine pairs of one person always weigh the same.
    for person in np.unique(genuine):
        columns = weights.genuine[:, genuine == person]
        assert (columns == columns[:, :1]).all()
    # Where a person was not drawn, their impostor pairs weigh nothing.
    one, two = people[known.first[~known.same]], people[known.second[~known.same]]
    for row in range(5):
        absent = {p for p in np.unique(genuine) if not weights.genuine[row, genuine == p].any()}
        touched = np.array([a in absent or b in absent for a, b in zip(one, two, strict=True)])
        assert not weights.impostor[row, touched].any()
    assert weights.genuine.mean() == pytest.approx(1, abs=0.1)


def test_pairs_are_drawn_where_people_have_no_names() -> None:
    nameless = material(people=20, pairs=60, named=False)
    weights = draw_weights(nameless, seed=1, replicates=50)
    assert weights.interval == "pair-bootstrap"
    total = weights.genuine.sum(axis=1) + weights.impostor.sum(axis=1)
    assert (total == len(nameless)).all()


@pytest.mark.parametrize("decimals", [1, 3])
def test_the_curve_is_that_of_the_metrics(decimals: int) -> None:
    generator = np.random.default_rng(decimals)
    mated = np.round(generator.normal(0.6, 0.2, 300), decimals)
    other = np.round(generator.normal(0, 0.2, 400), decimals)
    fmrs = np.array([3 / 400, 0.01, 0.1, 0.5])
    expected = [fnmr_at_fmr(mated, other, fmr)[1].value for fmr in fmrs]
    np.testing.assert_allclose(fnmr_curve(mated, other, fmrs), expected, atol=1e-12)


def test_a_replicate_is_the_curve_of_the_trials_it_repeats() -> None:
    generator = np.random.default_rng(5)
    mated, other = generator.normal(0.6, 0.3, 50), generator.normal(0, 0.3, 80)
    weights = Weights(
        generator.integers(0, 3, (6, 50)).astype(float),
        generator.integers(0, 3, (6, 80)).astype(float),
        "pair-bootstrap",
    )
    fmrs = np.array([0.05, 0.2, 1.0])
    found = fnmr_replicates(mated, other, weights, fmrs)
    for row in range(6):
        repeated = np.repeat(other, weights.impostor[row].astype(int))
        genuine = np.repeat(mated, weights.genuine[row].astype(int))
        for place, fmr in enumerate(fmrs):
            ranked = np.sort(repeated)[::-1]
            allowed = int(np.floor(fmr * len(ranked) + 1e-9))
            least = ranked[allowed] if allowed < len(ranked) else -np.inf
            # The cut lies above the first that is rejected, and accepts all above that one.
            above = ranked[ranked > least]
            most = above.min() if above.size else np.inf
            low = np.count_nonzero(genuine <= least) / len(genuine)
            high = np.count_nonzero(genuine < most) / len(genuine)
            assert low - 1e-6 <= found[row, place] <= high + 1e-6


def test_the_grid_begins_where_the_data_can_speak() -> None:
    grid = fmr_grid(3000)
    assert grid[0] == pytest.approx(1e-3)
    assert grid[-1] == 1
    assert fmr_grid(2)[0] == 1
