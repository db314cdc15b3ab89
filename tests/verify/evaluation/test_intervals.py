import numpy as np
import pytest

from tests.verify.evaluation.made_trials import made_trials
from verify.evaluation.intervals import OperatingPoints, replicate_weights
from verify.metrics import threshold_at_fmr


def test_replicates_weigh_people_as_often_as_they_are_drawn() -> None:
    known = made_trials(people=20, pairs=60)
    drawn = list(replicate_weights(known, seed=1, replicates=200))
    people = known.people
    assert people is not None
    person = people[0, known.same]
    one, two = people[:, ~known.same]
    for genuine, impostor in drawn:
        # All genuine pairs of one person weigh the same: how often the person was drawn.
        times = {p: genuine[person == p] for p in np.unique(person)}
        assert all((weights == weights[0]).all() for weights in times.values())
        both = [k for k in range(len(one)) if one[k] in times and two[k] in times]
        expected = [times[one[k]][0] * times[two[k]][0] for k in both]
        np.testing.assert_array_equal(impostor[both], expected)
    assert np.mean([genuine.mean() for genuine, _ in drawn]) == pytest.approx(1, abs=0.1)


def test_pairs_are_drawn_where_people_have_no_names() -> None:
    nameless = made_trials(people=20, pairs=60, named=False)
    for genuine, impostor in replicate_weights(nameless, seed=1, replicates=50):
        assert genuine.sum() + impostor.sum() == len(nameless)
        assert genuine.any()
        assert impostor.any()


@pytest.mark.parametrize("decimals", [1, 3])
def test_unweighted_points_are_those_of_the_metrics(decimals: int) -> None:
    generator = np.random.default_rng(decimals)
    mated = np.round(generator.normal(0.6, 0.2, 300), decimals)
    other = np.round(generator.normal(0, 0.2, 400), decimals)
    fmrs = np.array([3 / 400, 0.01, 0.1, 0.5])
    expected = [np.mean(mated < threshold_at_fmr(other, fmr)) for fmr in fmrs]
    np.testing.assert_allclose(OperatingPoints(mated, other).fnmr(fmrs), expected, atol=1e-12)


def test_weights_stand_for_trials_that_are_repeated() -> None:
    generator = np.random.default_rng(5)
    mated, other = generator.normal(0.6, 0.3, 50), generator.normal(0, 0.3, 80)
    points = OperatingPoints(mated, other)
    fmrs = np.array([0.05, 0.2, 1.0])
    for _ in range(6):
        genuine, impostor = generator.integers(0, 3, 50), generator.integers(0, 3, 80)
        found = points.fnmr(fmrs, genuine=genuine.astype(float), impostor=impostor.astype(float))
        ranked = np.sort(np.repeat(other, impostor))[::-1]
        repeated = np.repeat(mated, genuine)
        for place, fmr in enumerate(fmrs):
            allowed = int(np.floor(fmr * len(ranked) + 1e-9))
            least = ranked[allowed] if allowed < len(ranked) else -np.inf
            # The cut lies above the first that is rejected, and accepts all above that one.
            above = ranked[ranked > least]
            most = above.min() if above.size else np.inf
            low = np.count_nonzero(repeated <= least) / len(repeated)
            high = np.count_nonzero(repeated < most) / len(repeated)
            assert low - 1e-9 <= found[place] <= high + 1e-9
