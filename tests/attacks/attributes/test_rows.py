"""Measures against independent computations, and leakage on both sides of chance."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from sklearn.metrics import balanced_accuracy_score, confusion_matrix

from attacks.attributes.rows import AttributeRow, Leakage, measure
from attacks.errors import AuditError
from attacks.outcomes import RAW_SCHEME, KnowledgeLevel
from verify.metrics import wilson

CHANCE = np.random.default_rng(5)
TRUTH = CHANCE.choice(3, p=(0.6, 0.3, 0.1), size=1500)
TRAINING = CHANCE.choice(3, p=(0.3, 0.6, 0.1), size=400)
HALF_RIGHT = np.where(CHANCE.random(1500) < 0.5, TRUTH, CHANCE.integers(3, size=1500))


def against(predicted: Any, truth: Any = TRUTH, *, training: Any = TRAINING) -> AttributeRow:
    return measure(
        predicted,
        truth,
        scheme=RAW_SCHEME,
        attribute="race",
        attacker="knn",
        metric=None,
        knowledge=KnowledgeLevel.ALGORITHM,
        classes=("A", "B", "C"),
        training=training,
        seed=0,
    )


def test_measures_agree_with_scikit_learn_and_wilson() -> None:
    row = against(HALF_RIGHT)
    hits = int(np.sum(HALF_RIGHT == TRUTH))
    assert (row.accuracy.errors, row.accuracy.trials) == (hits, 1500)
    assert (row.accuracy.ci_low, row.accuracy.ci_high) == wilson(hits, 1500)
    assert row.balanced_accuracy == pytest.approx(balanced_accuracy_score(TRUTH, HALF_RIGHT))
    np.testing.assert_array_equal(row.confusion, confusion_matrix(TRUTH, HALF_RIGHT))
    assert row.leakage is Leakage.ABOVE
    p, q = np.bincount(TRUTH) / 1500, np.bincount(HALF_RIGHT) / 1500
    assert row.baselines == pytest.approx(
        {
            "uniform": 1 / 3,
            "majority": p.max(),
            "majority_of_training": p[1],
            "prior": p @ p,
            "same_predictions": p @ q,
        }
    )


def test_predictions_independent_of_the_truth_do_not_leak_though_below_the_majority() -> None:
    verdicts = []
    for seed in range(100):
        row = against(np.random.default_rng(seed).integers(3, size=1500))
        assert row.accuracy.value < row.chance - 0.2
        verdicts.append(row.leakage)
    # Of 100 tests at 0.01, five or more false alarms have a probability of 0.003.
    assert verdicts.count(Leakage.NONE) >= 96


def test_a_rule_turned_round_leaks_below() -> None:
    truth = np.random.default_rng(1).integers(2, size=400)
    wrong = np.where(np.random.default_rng(2).random(400) < 0.7, 1 - truth, truth)
    below, above = against(wrong, truth), against(1 - wrong, truth)
    assert (below.leakage, above.leakage) == (Leakage.BELOW, Leakage.ABOVE)
    assert below.strength == pytest.approx(above.strength, abs=0.05)


def test_a_constant_guess_tells_nothing() -> None:
    row = against(np.zeros(1500, int))
    assert (row.leakage, row.p_value, row.strength) == (Leakage.NONE, 1, 0)


def test_p_value_is_that_of_all_permutations() -> None:
    truth = np.array([0, 0, 0, 1, 1, 2, 2, 2])
    predicted = np.array([0, 0, 1, 1, 1, 2, 2, 0])
    counts = np.array(
        [
            sum(a == b for a, b in zip(truth, order, strict=True))
            for order in itertools.permutations(predicted.tolist())
        ]
    )
    row = against(predicted, truth)
    assert row.chance_of_predictions * 8 == pytest.approx(counts.mean())
    away = max(0.0, abs(6 - counts.mean()) - 0.5)
    assert row.p_value == pytest.approx(math.erfc(away / math.sqrt(2 * counts.var())))
    exact = np.mean(np.abs(counts - counts.mean()) >= abs(6 - counts.mean()))
    assert row.p_value == pytest.approx(exact, abs=0.02)


def test_predictions_that_do_not_fit_are_refused() -> None:
    with pytest.raises(AuditError, match="2 predictions do not fit 3"):
        against(np.zeros(2, int), np.zeros(3, int))
