"""A comparer links what hardly protects, and neither different people nor what it cannot see."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import subspace_angles
from sklearn.metrics import roc_auc_score

from attacks.comparer import PairFeatures, link_by_comparer, separation, train_comparer
from attacks.outcomes import AttackOutcome, Leaked, Property
from attacks.population import Population
from attacks.system import System
from attacks.unlinkability import unlinkability

NEAREST, LARGEST, SQUARES = 0, 4, 5


def figure(outcome: AttackOutcome, name: str) -> float:
    return float(str(outcome.details[name]))


def test_a_trained_comparer_links_what_hardly_protects(
    weak_system: System, small_population: Population
) -> None:
    linked, control = link_by_comparer(weak_system, small_population.mates)
    assert linked.measured.value > 0.9
    assert figure(linked, "auc") > 0.99
    assert linked.judged
    assert (linked.breaks, linked.leaked) == (Property.UNLINKABILITY, Leaked.HOLDER_KEYS)
    assert control.measured.value <= figure(control, "null_95_percent")
    assert not control.judged


def test_different_people_do_not_link(
    system: System, small_population: Population, strangers: np.ndarray
) -> None:
    others = replace(system, victims=replace(system.victims, fresh=strangers))
    row, _control = link_by_comparer(others, small_population.mates)
    assert row.measured.value <= figure(row, "null_95_percent")
    assert figure(row, "auc") == pytest.approx(0.5, abs=0.1)


def test_it_links_no_worse_than_the_nearest_points_alone(
    system: System, small_population: Population
) -> None:
    """On templates whose decoys are of the people's own kind, by features of the pair."""
    features = PairFeatures(system)
    mates, victims = small_population.mates, system.victims

    def compared(enrolled: np.ndarray, fresh: np.ndarray, purpose: str) -> np.ndarray:
        sides = system.lift(enrolled, f"{purpose}, one"), system.lift(fresh, f"{purpose}, other")
        return features(*sides)

    comparer = train_comparer(compared(mates.enrolled, mates.fresh, "mates")[None])
    shown = compared(victims.enrolled, victims.fresh, "victims")
    logits = comparer.decision_function(shown.reshape(-1, shown.shape[2])).reshape(shown.shape[:2])
    mated = np.eye(len(shown), dtype=bool).ravel()
    alone = roc_auc_score(mated, shown[:, :, NEAREST].ravel())
    assert roc_auc_score(mated, logits.ravel()) > alone - 0.02
    assert alone > 0.6


def test_a_comparer_that_was_trained_on_the_wrong_mates_links_nothing(
    weak_system: System, small_population: Population
) -> None:
    mates = small_population.mates
    wrong = replace(mates, fresh=np.roll(mates.fresh, 1, axis=0))
    row, _control = link_by_comparer(weak_system, wrong)
    right, _ = link_by_comparer(weak_system, mates)
    assert figure(row, "auc") < figure(right, "auc") - 0.1


def test_few_mates_train_no_comparer(system: System, small_population: Population) -> None:
    assert link_by_comparer(system, small_population.mates.first(19)) == []


def test_the_features_of_the_spans_are_those_of_their_principal_angles(system: System) -> None:
    left, right = system.templates[:3], system.templates[5:9]
    found = PairFeatures(system)(left, right)
    for i in range(3):
        for j in range(4):
            spans = [
                np.concatenate([batch.feet[row][None], batch.bases[row]]).T.astype(float)
                for batch, row in ((left, i), (right, j))
            ]
            cosines = np.cos(subspace_angles(*spans))
            assert found[i, j, SQUARES] == pytest.approx((cosines**2).sum(), rel=1e-3)
            assert cosines.max() - 0.05 < found[i, j, LARGEST] < cosines.max() + 1e-4


def test_separation_is_that_of_scikit_learn() -> None:
    rng = np.random.default_rng(3)
    scores = rng.normal(size=(3, 40, 40)).round(1) + 2 * np.eye(40)
    mated = np.broadcast_to(np.eye(40, dtype=bool), scores.shape)
    found = separation(scores)
    assert found["auc"] == pytest.approx(roc_auc_score(mated.ravel(), scores.ravel()))
    assert found["linked_at_fmr_1e-3"] is not None
    assert separation(scores[:1, :20, :20])["linked_at_fmr_1e-3"] is None
    assert unlinkability(scores, seed=0).d_sys.value > 0.3
