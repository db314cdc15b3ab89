import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from templates.errors import ContractError
from verify.tenfold import FOLDS, best_threshold, random_pairs, ten_fold

trials = st.lists(
    st.tuples(st.integers(-5, 5).map(lambda k: k / 4), st.booleans()), min_size=1, max_size=30
)


@given(trials)
def test_best_threshold_has_the_best_accuracy_of_all(pairs: list[tuple[float, bool]]) -> None:
    scores = np.array([score for score, _ in pairs])
    same = np.array([truth for _, truth in pairs])
    candidates = [*scores.tolist(), 10.0]
    best = max(int(((scores >= candidate) == same).sum()) for candidate in candidates)
    assert int(((scores >= best_threshold(scores, same)) == same).sum()) == best


def test_ten_folds_choose_on_nine_and_apply_to_the_tenth() -> None:
    # Fold 0 is shifted, so that a threshold that had seen it would do better on it.
    folds = np.repeat(np.arange(FOLDS), 4)
    scores = np.tile([0.6, 0.8, 0.2, 0.4], FOLDS) + 0.5 * (folds == 0)
    result = ten_fold(scores, np.tile([True, True, False, False], FOLDS), folds)
    assert result.accuracies[0] == 0.5
    assert result.accuracies[1:] == (1.0,) * 9 or min(result.accuracies[1:]) >= 0.75
    assert result.thresholds[0] == pytest.approx(0.5)
    assert result.accuracy_mean == pytest.approx(np.mean(result.accuracies))
    assert result.accuracy_std == pytest.approx(np.std(result.accuracies))


def test_random_pairs_are_balanced_true_and_distinct() -> None:
    person_of = np.repeat(np.arange(12), 4)
    pairs = random_pairs(person_of, rng=np.random.default_rng(0), most_per_class=50)
    assert (len(pairs.same), np.count_nonzero(pairs.same)) == (100, 50)
    genuine = set(zip(pairs.first[pairs.same], pairs.second[pairs.same], strict=True))
    assert len(genuine) == 50
    np.testing.assert_array_equal(person_of[pairs.first] == person_of[pairs.second], pairs.same)
    assert not (pairs.first == pairs.second).any()
    for kind in (pairs.same, ~pairs.same):
        assert np.bincount(pairs.folds[kind]).tolist() == [5] * FOLDS
    with pytest.raises(ContractError, match="two people; seen 0 pairs and 50 people"):
        random_pairs(np.arange(50), rng=np.random.default_rng(0))
