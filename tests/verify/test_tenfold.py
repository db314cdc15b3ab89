import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from templates.errors import ContractError
from verify.tenfold import FOLDS, Pair, best_threshold, pair_arrays, random_pairs, ten_fold

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
    pairs, scores = [], []
    for fold in range(FOLDS):
        shift = 0.5 if fold == 0 else 0.0
        for same, score in ((True, 0.6), (True, 0.8), (False, 0.2), (False, 0.4)):
            pairs.append(Pair(0, 1, same, fold))
            scores.append(score + shift)
    result = ten_fold(scores, *pair_arrays(pairs))
    assert result.accuracies[0] == 0.5
    assert result.accuracies[1:] == (1.0,) * 9 or min(result.accuracies[1:]) >= 0.75
    assert result.thresholds[0] == pytest.approx(0.5)
    assert result.accuracy_mean == pytest.approx(np.mean(result.accuracies))
    assert result.accuracy_std == pytest.approx(np.std(result.accuracies))


def test_a_missing_fold_is_refused() -> None:
    pairs = [Pair(0, 1, True, fold) for fold in range(9)]
    with pytest.raises(ContractError, match=r"each of 10 folds.*protocol fmr"):
        ten_fold(np.zeros(9), *pair_arrays(pairs))
    with pytest.raises(ContractError, match="0 pairs are there"):
        ten_fold(np.zeros(0), *pair_arrays([]))


def test_random_pairs_are_balanced_true_and_distinct() -> None:
    person_of = np.repeat(np.arange(12), 4)
    pairs = random_pairs(person_of, rng=np.random.default_rng(0), most_per_class=50)
    same = [pair for pair in pairs if pair.same]
    assert len(same) == 50
    assert len(pairs) == 100
    assert len({(pair.first, pair.second) for pair in same}) == 50
    for pair in pairs:
        assert (person_of[pair.first] == person_of[pair.second]) == pair.same
        assert pair.first != pair.second
    assert {pair.fold for pair in same} == set(range(FOLDS))
    with pytest.raises(ContractError, match="two people; seen 0 pairs and 50 people"):
        random_pairs(np.arange(50), rng=np.random.default_rng(0))
