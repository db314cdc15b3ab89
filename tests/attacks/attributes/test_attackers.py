"""The trained attacker finds what is there, and nothing where nothing is."""

import numpy as np
import pytest

from attacks.attributes.attackers import Logistic, TrainingSet
from attacks.attributes.features import Features

N, F = 400, 12


def made(signal: bool, chance: np.random.Generator) -> tuple[Features, np.ndarray]:
    """Features whose class is the side of a circle they lie on: no linear rule finds it."""
    rows = chance.standard_normal((N, F)).astype(np.float32)
    inside = (rows[:, 0] ** 2 + rows[:, 1] ** 2 < 1.4).astype(np.int64)
    codes = inside if signal else chance.integers(2, size=N)
    derived = np.hstack([rows, rows[:, :2] ** 2])
    return Features(chance.standard_normal((N, 4)).astype(np.float32) / 20, derived), codes


def training(signal: bool) -> tuple[TrainingSet, Features, np.ndarray]:
    chance = np.random.default_rng(8)
    (features, codes), (held, held_codes), (unseen, truth) = (
        made(signal, chance) for _ in range(3)
    )
    third = chance.integers(2, size=N)
    return (
        TrainingSet(
            features,
            {"side": codes, "noise": third},
            held,
            {"side": held_codes, "noise": third},
            {"side": 2, "noise": 4},
        ),
        unseen,
        truth,
    )


@pytest.mark.parametrize("foot", [False, True])
def test_finds_a_rule(foot: bool) -> None:
    known, unseen, truth = training(signal=True)
    scores = Logistic(known, foot=foot).scores(unseen)
    assert np.mean(np.argmax(scores["side"], axis=1) == truth) > 0.85


@pytest.mark.parametrize("foot", [False, True])
def test_finds_none_in_noise(foot: bool) -> None:
    known, unseen, truth = training(signal=False)
    found = int(
        np.sum(np.argmax(Logistic(known, foot=foot).scores(unseen)["side"], axis=1) == truth)
    )
    # Four standard deviations of a fair coin.
    assert abs(found - N / 2) < 4 * np.sqrt(N / 4)


@pytest.mark.parametrize("foot", [False, True])
def test_never_predicts_a_class_without_training_faces(foot: bool) -> None:
    known, unseen, _ = training(signal=True)
    scores = Logistic(known, foot=foot).scores(unseen)["noise"]
    assert scores.shape == (N, 4)
    assert np.argmax(scores, axis=1).max() <= 1
