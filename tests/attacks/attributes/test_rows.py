"""Measures against independent computations, and leakage on both sides of chance."""

from typing import Any

import numpy as np
import pytest
from sklearn.metrics import balanced_accuracy_score, confusion_matrix

from attacks.attributes.rows import AttributeRow, measure
from attacks.outcomes import RAW_SCHEME, KnowledgeLevel
from verify.metrics import wilson

CHANCE = np.random.default_rng(5)
TRUTH = CHANCE.choice(3, p=(0.6, 0.3, 0.1), size=1500)
HALF_RIGHT = np.where(CHANCE.random(1500) < 0.5, TRUTH, CHANCE.integers(3, size=1500))


def against(predicted: Any, truth: Any = TRUTH) -> AttributeRow:
    return measure(
        predicted,
        truth,
        scheme=RAW_SCHEME,
        attribute="race",
        attacker="knn",
        metric=None,
        knowledge=KnowledgeLevel.ALGORITHM,
        classes=("A", "B", "C"),
        seed=0,
    )


def test_measures_agree_with_scikit_learn_and_wilson() -> None:
    row = against(HALF_RIGHT)
    hits = int(np.sum(HALF_RIGHT == TRUTH))
    assert (row.accuracy.errors, row.accuracy.trials) == (hits, 1500)
    assert (row.accuracy.ci_low, row.accuracy.ci_high) == wilson(hits, 1500)
    assert row.balanced_accuracy == pytest.approx(balanced_accuracy_score(TRUTH, HALF_RIGHT))
    np.testing.assert_array_equal(row.confusion, confusion_matrix(TRUTH, HALF_RIGHT))
    p, q = np.bincount(TRUTH) / 1500, np.bincount(HALF_RIGHT) / 1500
    assert row.baselines == pytest.approx(
        {
            "uniform": 1 / 3,
            "majority": p.max(),
            "same_predictions": p @ q,
        }
    )


def test_a_rule_turned_round_is_as_strong_and_what_knows_nothing_is_not() -> None:
    truth = np.random.default_rng(1).integers(2, size=400)
    wrong = np.where(np.random.default_rng(2).random(400) < 0.7, 1 - truth, truth)
    below, above = against(wrong, truth), against(1 - wrong, truth)
    assert below.accuracy.ci_high < below.chance_of_predictions
    assert above.accuracy.ci_low > above.chance_of_predictions
    assert below.strength == pytest.approx(above.strength, abs=0.05)
    assert against(np.zeros(1500, int)).strength == 0
    blind = against(np.random.default_rng(3).integers(3, size=1500))
    assert blind.accuracy.value < blind.chance - 0.2
    assert blind.strength < 0.03
