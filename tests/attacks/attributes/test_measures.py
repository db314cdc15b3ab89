"""InferenceMeasures against independent computations, and leakage on both sides of chance."""

import itertools
import math

import numpy as np
import pytest
from sklearn.metrics import balanced_accuracy_score, confusion_matrix, mutual_info_score

from attacks.attributes.measures import Leakage, measure
from attacks.errors import AuditError
from verify.metrics import wilson

CHANCE = np.random.default_rng(5)
TRUTH = CHANCE.choice(3, p=(0.6, 0.3, 0.1), size=1500)
TRAINING = CHANCE.choice(3, p=(0.3, 0.6, 0.1), size=400)
HALF_RIGHT = np.where(CHANCE.random(1500) < 0.5, TRUTH, CHANCE.integers(3, size=1500))


def test_measures_agree_with_scikit_learn_and_wilson() -> None:
    found = measure(HALF_RIGHT, TRUTH, training=TRAINING, classes=3, seed=0)
    hits = int(np.sum(HALF_RIGHT == TRUTH))
    assert (found.accuracy.errors, found.accuracy.trials) == (hits, 1500)
    assert (found.accuracy.ci_low, found.accuracy.ci_high) == wilson(hits, 1500)
    assert found.balanced_accuracy == pytest.approx(balanced_accuracy_score(TRUTH, HALF_RIGHT))
    np.testing.assert_array_equal(found.confusion, confusion_matrix(TRUTH, HALF_RIGHT))
    bits = mutual_info_score(TRUTH, HALF_RIGHT) / math.log(2)
    assert found.information.bits == pytest.approx(bits)
    assert found.information.bits > 5 * found.information.null_high
    assert found.leakage is Leakage.ABOVE


def test_baselines() -> None:
    found = measure(HALF_RIGHT, TRUTH, training=TRAINING, classes=3, seed=0).baselines
    p, q = np.bincount(TRUTH) / 1500, np.bincount(HALF_RIGHT) / 1500
    assert found.uniform == pytest.approx(1 / 3)
    assert found.majority == p.max()
    assert found.majority_of_training == p[1]
    assert found.prior == pytest.approx(np.sum(p**2))
    assert found.same_predictions == pytest.approx(np.sum(p * q))


def test_predictions_independent_of_the_truth_do_not_leak_though_below_the_majority() -> None:
    verdicts = []
    for seed in range(100):
        guesses = np.random.default_rng(seed).integers(3, size=1500)
        found = measure(guesses, TRUTH, training=TRAINING, classes=3, seed=0, permutations=1)
        assert found.advantage < -0.2
        verdicts.append(found.leakage)
    # Of 100 tests at 0.01, five or more false alarms have a probability of 0.003.
    assert verdicts.count(Leakage.NONE) >= 96


def test_a_rule_turned_round_leaks_below() -> None:
    truth = np.random.default_rng(1).integers(2, size=400)
    wrong = np.where(np.random.default_rng(2).random(400) < 0.7, 1 - truth, truth)
    below = measure(wrong, truth, training=truth, classes=2, seed=0)
    assert below.leakage is Leakage.BELOW
    above = measure(1 - wrong, truth, training=truth, classes=2, seed=0)
    assert above.leakage is Leakage.ABOVE
    assert above.information.bits == pytest.approx(below.information.bits)
    assert below.strength == pytest.approx(above.strength, abs=0.05)


def test_a_constant_guess_tells_nothing() -> None:
    found = measure(np.zeros(1500, int), TRUTH, training=TRAINING, classes=3, seed=0)
    assert found.leakage is Leakage.NONE
    assert found.information.bits == 0
    assert found.p_value == 1
    assert found.advantage == found.strength == 0


def test_p_value_is_that_of_all_permutations() -> None:
    truth = np.array([0, 0, 0, 1, 1, 2, 2, 2])
    predicted = np.array([0, 0, 1, 1, 1, 2, 2, 0])
    counts = np.array(
        [sum(a == b for a, b in zip(truth, p, strict=True)) for p in _arrangements(predicted)]
    )
    found = measure(predicted, truth, training=truth, classes=3, seed=0)
    assert found.baselines.same_predictions * 8 == pytest.approx(counts.mean())
    away = max(0.0, abs(6 - counts.mean()) - 0.5)
    normal = math.erfc(away / math.sqrt(2 * counts.var()))
    assert found.p_value == pytest.approx(normal)
    exact = np.mean(np.abs(counts - counts.mean()) >= abs(6 - counts.mean()))
    assert found.p_value == pytest.approx(exact, abs=0.02)


def _arrangements(predicted: np.ndarray) -> list[tuple[int, ...]]:
    return list(itertools.permutations(predicted.tolist()))


def test_the_null_of_the_information_is_seeded() -> None:
    one, same = (measure(HALF_RIGHT, TRUTH, training=TRAINING, classes=3, seed=7) for _ in "ab")
    assert one == same


def test_predictions_that_do_not_fit_are_refused() -> None:
    with pytest.raises(AuditError, match="2 predictions do not fit 3"):
        measure(np.zeros(2, int), np.zeros(3, int), training=np.zeros(1, int), classes=2, seed=0)
