import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.extraction import Failure
from templates.distances import Metric
from tests.verify.evaluation.materials import N, material, pool
from verify.datasets import DatasetError
from verify.evaluation.acquisition import Acquired, EmbeddedSet
from verify.evaluation.evaluation import Evaluated, evaluate_set, prepare
from verify.evaluation.measures import measure
from verify.evaluation.plan import EvaluationPlan
from verify.evaluation.results import Model, SetResult, document
from verify.evaluation.rows import SetFacts, collision_floor, row_json
from verify.evaluation.units import Cell, Mode
from verify.evaluation.verification_set import PictureBytes, VerificationSet, contiguous_folds

PLAN = EvaluationPlan(("raw", "random", "adversarial"), dims=(2, 3), repeats=2, targets=(0.1, 1e-4))


def verification_set(pairs: int = 100, people: int = 30) -> VerificationSet:
    known = material(people=people, pairs=pairs)
    return VerificationSet(
        name="made",
        kind="pairs",
        pictures=tuple(PictureBytes(f"{i}", b"") for i in range(2 * people)),
        first=known.first,
        second=known.second,
        same=known.same,
        folds=known.folds,
        people=tuple(f"p{i // 2}" for i in range(2 * people)),
    )


def run(plan: EvaluationPlan = PLAN) -> Evaluated:
    facts = SetFacts("made", 50, 50, 0, 0, 0.0, names_people=True)
    with ThreadPoolExecutor(2) as executor:
        return evaluate_set(
            material(),
            facts,
            np.arange(100),
            plan=plan,
            executor=executor,
            progress=lambda _: None,
        )


def document_of(evaluated: Evaluated, plan: EvaluationPlan = PLAN) -> dict[str, Any]:
    pairs = verification_set()
    acquired = Acquired(np.empty((0, N), np.float32), np.empty(0, np.int64), ())
    whole = SetResult(EmbeddedSet(pairs, acquired, True, "0" * 64), evaluated, ())
    return document(
        plan, Model(N, {}), [], [whole], options={}, timings=[], groups=[], group_summaries=[]
    )


def test_rows_are_means_of_their_runs() -> None:
    results = document_of(run())
    rows, runs = results["rows"], results["runs"]
    # raw by two searches; 2 strategies x 2 dims x 2 modes x 2 metrics.
    assert len(rows) == 2 + 2 * 2 * 2 * 2
    keys = ("strategy", "dim", "mode", "metric", "threshold_search")
    for row in rows:
        own = [each for each in runs if all(each[key] == row[key] for key in keys)]
        sides = 2 if row["mode"] == "p2s" else 1
        assert len(own) == row["runs"] == (1 if row["strategy"] == "raw" else 2 * sides)
        means = [np.mean(each["accuracies"]) for each in own]
        assert row["accuracy_mean"] == pytest.approx(np.mean(means))
        assert row["accuracy_std"] == pytest.approx(
            np.mean([np.std(each["accuracies"]) for each in own])
        )
        seeds = {each["seed"] for each in own}
        by_seed = [
            np.mean([m for m, each in zip(means, own, strict=True) if each["seed"] == seed])
            for seed in seeds
        ]
        spread = pytest.approx(np.std(by_seed, ddof=1)) if len(seeds) > 1 else None
        assert row["accuracy_std_seeds"] == spread
        for figure in ("eer", "auc", "d_prime"):
            assert row[figure] == pytest.approx(np.mean([each[figure] for each in own]))
        at = row["fnmr_at_fmr"]["0.1"]
        errors = [each["fnmr_at_fmr"]["0.1"]["errors"] for each in own]
        assert at["value"] == pytest.approx(np.mean(errors) / 50)
        assert at["ci_low"] <= at["value"] <= at["ci_high"]
        assert at["fmr"] <= 0.1
        assert "0.0001" not in row["fnmr_at_fmr"]
    assert "made: FMR 0.0001 is not reported" in results["refused"][0]
    assert len(results["curves"]) == len(rows) - 1


def test_pairs_without_a_descriptor_are_counted() -> None:
    pairs = verification_set()
    rows = np.arange(60)
    lost = pairs.pictures[int(pairs.first[0])].name
    rows[int(lost)] = -1
    rows[rows > int(lost)] -= 1
    acquired = Acquired(
        np.delete(material().descriptors, int(lost), axis=0),
        rows,
        (Failure(Path(lost), "no_face", "No face was found."),),
    )
    known, facts, kept = prepare(pairs, acquired, attributes=None, sources=())
    touched = (pairs.first == int(lost)) | (pairs.second == int(lost))
    assert facts.failed_genuine == np.count_nonzero(touched & pairs.same) > 0
    assert facts.failed_impostor == np.count_nonzero(touched & ~pairs.same)
    assert facts.fta == 1 / 60
    np.testing.assert_array_equal(kept, np.flatnonzero(~touched))
    np.testing.assert_array_equal(
        known.descriptors[known.first], material().descriptors[pairs.first[~touched]]
    )
    assert known.people is not None
    numbers = {name: number for number, name in enumerate(sorted(set(pairs.people or ())))}
    np.testing.assert_array_equal(
        known.people[0], [numbers[f"p{i // 2}"] for i in pairs.first[~touched]]
    )
    everything = Acquired(acquired.descriptors[:0], np.full(60, -1), acquired.failures)
    with pytest.raises(DatasetError, match="without the 100 pairs that lack an embedding"):
        prepare(pairs, everything, attributes=None, sources=())


def test_rates_with_failures_follow_the_standard() -> None:
    evaluated = run(EvaluationPlan(("raw",), targets=(0.1,)))
    facts = SetFacts("made", 50, 50, 3, 2, 0.04, names_people=False)
    (first, *_) = evaluated.runs
    row = row_json(first.cell, "grid", [first], facts, seed=0, n=N, source=None, contract_id=None)
    at = row["fnmr_at_fmr"]["0.1"]
    assert at["interval"] == "pair-bootstrap"
    assert at["far"] == pytest.approx(at["fmr"] * 0.96)
    assert at["frr"] == pytest.approx(0.04 + at["value"] * 0.96)


@pytest.mark.parametrize(
    ("strategy", "dim", "entries", "expected"),
    [
        # By hand: with 1 decoy of 10, the second side draws the same with probability 1/10.
        ("hybrid", 2, 10, 0.1),
        # 1 - C(8, 2) / C(10, 2)
        ("adversarial", 2, 10, 1 - 28 / 45),
        ("random", 2, 10, 0.0),
        # One of 16 parts of 10 entries each, and inside it as above.
        ("sub-adversarial", 2, 160, (1 - 28 / 45) / 16),
        ("hybrid+", 2, 10, None),
    ],
)
def test_the_collision_floor(strategy: str, dim: int, entries: int, expected: float | None) -> None:
    source = pool(entries, labelled=True)
    shared = Cell(strategy, "pool", True, dim, Mode.SUBSPACE, Metric.EUCLIDEAN.value)
    found = collision_floor(shared, source)
    assert found == (None if expected is None else pytest.approx(expected))
    apart = Cell(strategy, "pool", False, dim, Mode.SUBSPACE, Metric.EUCLIDEAN.value)
    assert collision_floor(apart, source) == 0


def test_folds_of_the_made_up_set_are_those_of_the_literature() -> None:
    np.testing.assert_array_equal(np.bincount(contiguous_folds(103)), [11, 11, 11] + [10] * 7)


def test_classes_without_spread_give_a_document() -> None:
    evaluated = run(EvaluationPlan(("raw",)))
    first = evaluated.runs[0]
    flat = np.where(evaluated.material.same, 1.0, 0.0)
    folds = evaluated.material.folds
    measures = measure(flat, evaluated.material.same, folds, targets=())
    row = row_json(
        first.cell,
        "exact",
        [replace(first, measures=measures)],
        evaluated.facts,
        seed=0,
        n=N,
        source=None,
        contract_id=None,
    )
    assert row["d_prime"] is None
    json.dumps(row, allow_nan=False)
