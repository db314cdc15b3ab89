import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import KFold

from verify.evaluation.measures import measure
from verify.evaluation.verification_set import contiguous_folds
from verify.tenfold import best_grid_threshold, ten_fold


def scores_of(pairs: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    same = generator.random(pairs) < 0.5
    return np.where(same, 0.5, 0.0) + generator.normal(0, 0.2, pairs), same


def literature(similarities: np.ndarray, same: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Ten-fold ROC as published code has it, written down anew: fold by fold, t by t."""
    distances = 2 - 2 * similarities
    thresholds = np.arange(0, 4, 0.01)
    accuracies, chosen = [], []
    for train, test in KFold(10, shuffle=False).split(distances):
        trained = [np.mean((distances[train] < t) == same[train]) for t in thresholds]
        best = thresholds[int(np.argmax(trained))]
        chosen.append(best)
        accuracies.append(np.mean((distances[test] < best) == same[test]))
    return np.array(accuracies), chosen


@pytest.mark.parametrize("pairs", [600, 603, 700])
def test_the_grid_gives_the_accuracies_of_the_literature(pairs: int) -> None:
    similarities, same = scores_of(pairs, seed=pairs)
    accuracies, thresholds = literature(similarities, same)
    found = ten_fold(similarities, same, contiguous_folds(pairs), search=best_grid_threshold)
    np.testing.assert_array_equal(found.accuracies, accuracies)
    np.testing.assert_allclose(2 - 2 * np.array(found.thresholds), thresholds, atol=1e-9)


def test_a_distance_on_the_grid_is_not_below_it() -> None:
    # 2 - 2s = 1 exactly: t = 1.00 must not accept it, t = 1.01 must.
    threshold = best_grid_threshold([0.5, 0.4], [True, False])
    assert threshold <= 0.5
    assert threshold > 1 - 1.01 / 2


@given(st.integers(0, 2**32 - 1))
def test_figures_equal_those_of_independent_code(seed: int) -> None:
    similarities, same = scores_of(200, seed)
    similarities = np.round(similarities, 1)  # ties
    found = measure(similarities, same, contiguous_folds(200), targets=(0.5, 0.05, 1e-3))
    assert found["auc"] == pytest.approx(roc_auc_score(same, similarities))
    mated, other = similarities[same], similarities[~same]
    assert list(found["fnmr_at_fmr"]) == ["0.5", "0.05"]
    for target, at in found["fnmr_at_fmr"].items():
        assert at["fmr_errors"] == np.count_nonzero(other >= at["threshold"])
        assert at["errors"] == np.count_nonzero(mated < at["threshold"])
        assert at["fmr_errors"] / at["fmr_trials"] <= float(target)
        # No lower threshold keeps the target.
        lower = other[other < at["threshold"]].max()
        assert np.count_nonzero(other >= lower) / other.size > float(target)
