"""Runs, rows and curves against means, intervals and counts that are made anew."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from models.extraction import Failure
from templates.distances import Metric
from tests.verify.evaluation.made_results import made_faces, made_results, verification_set
from tests.verify.evaluation.made_trials import made_trials
from verify.datasets import DatasetError
from verify.evaluation.comparison import Trials
from verify.evaluation.experiment import (
    ROW,
    averaged,
    run_trials,
    trials_of,
)
from verify.evaluation.intervals import replicate_weights
from verify.evaluation.plan import EvaluationPlan, Mode
from verify.evaluation.results import row_of
from verify.metrics import threshold_at_fmr, wilson

# One kind of run whose lifts differ much, so that the draw of runs shows.
SPREAD = EvaluationPlan(
    ("adversarial",),
    dims=(2,),
    modes=(Mode.SUBSPACE,),
    metrics=(Metric.EUCLIDEAN,),
    shared_decoys=True,
    repeats=4,
    targets=(0.05,),
    steps=9,
)


def run(plan: EvaluationPlan, trials: Trials | None = None) -> pd.DataFrame:
    with ThreadPoolExecutor(2) as executor:
        return run_trials(trials or made_trials(), plan, executor=executor, progress=lambda _: None)


def test_rows_are_means_of_their_runs() -> None:
    results = made_results()
    rows, runs = results["rows"], results["runs"]
    # Raw by two searches; random, and two strategies with pool and with generator, in
    # 2 dims x 2 modes x 2 metrics.
    assert len(rows) == 2 + (1 + 2 * 2) * 2 * 2 * 2
    for row in rows:
        own = [each for each in runs if all(each[key] == row[key] for key in ROW)]
        sides = 2 if row["mode"] == "p2s" else 1
        assert len(own) == row["runs"] == (2 * sides if row["dim"] else 1)
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
        for figure in ("eer", "auc"):
            assert row[figure] == pytest.approx(np.mean([each[figure] for each in own]))
        at = row["fnmr_at_fmr"]["0.1"]
        errors = [each["fnmr_at_fmr"]["0.1"]["errors"] for each in own]
        assert at["value"] == pytest.approx(np.mean(errors) / 50)
        assert at["ci_low"] <= at["value"] <= at["ci_high"]
        assert at["fmr"] <= 0.1
        assert "0.0001" not in row["fnmr_at_fmr"]
    assert "lfw: FMR 0.0001 is not reported" in results["refused"][0]
    assert len(results["curves"]) == len(rows) - 1


def test_a_set_without_folds_has_every_figure_but_the_accuracy() -> None:
    trials = made_trials()
    plan = EvaluationPlan(("raw", "random"), dims=(2,), repeats=2, targets=(0.1,))
    folded, plain = run(plan, trials), run(plan, replace(trials, folds=None))
    # The grid is a search for the accuracy: without folds it has nothing to choose.
    assert set(plain["threshold_search"]) == {"exact"}
    row, other = (
        row_of(lines[lines["strategy"] == "random"][:1], trials, plan) for lines in (plain, folded)
    )
    missing = {name for name, value in row.items() if value is None}
    assert missing - {name for name, value in other.items() if value is None} == {
        *("accuracy_mean", "accuracy_std", "threshold_mean"),
    }
    assert row["fnmr_at_fmr"] == other["fnmr_at_fmr"]


def test_pairs_without_an_embedding_are_counted() -> None:
    pairs = verification_set()
    lost = int(pairs.first[0])
    rows = np.arange(60)
    rows[lost] = -1
    rows[rows > lost] -= 1
    acquired = made_faces(
        rows,
        embeddings=np.delete(made_trials().embeddings, lost, axis=0),
        failures=(Failure(Path(pairs.pictures[lost].name), "no_face", "No face was found."),),
    )
    known = trials_of(acquired, attributes=None, sources=())
    touched = (pairs.first == lost) | (pairs.second == lost)
    assert known.failed_genuine == np.count_nonzero(touched & pairs.same) > 0
    assert known.failed_impostor == np.count_nonzero(touched & ~pairs.same)
    assert known.fta == 1 / 60
    np.testing.assert_array_equal(known.kept, np.flatnonzero(~touched))
    np.testing.assert_array_equal(
        known.embeddings[known.first], made_trials().embeddings[pairs.first[~touched]]
    )
    assert known.people is not None
    numbers = {name: number for number, name in enumerate(sorted(set(pairs.people or ())))}
    np.testing.assert_array_equal(
        known.people[0], [numbers[f"p{i // 2}"] for i in pairs.first[~touched]]
    )
    with pytest.raises(DatasetError, match="without the 100 pairs that lack an embedding"):
        trials_of(made_faces(np.full(60, -1)), attributes=None, sources=())


def test_a_template_is_the_mean_of_its_photos_that_were_acquired() -> None:
    rows = np.arange(60)
    rows[[2, 5, 6]] = -1
    means = averaged(made_faces(rows), [(0, 1), (2, 3), (4,), (5, 6)])
    np.testing.assert_array_equal(means.rows, [0, 1, 2, -1])
    photos = made_trials().embeddings.astype(float)
    mean = photos[0] + photos[1]
    np.testing.assert_allclose(means.embeddings[0], mean / np.linalg.norm(mean), atol=1e-6)
    np.testing.assert_allclose(means.embeddings[1:], photos[[3, 4]], atol=1e-6)


def written_out(known: Trials, runs: pd.DataFrame, fmr: float) -> tuple[float, float]:
    """95 % interval of the mean FNMR: trials repeated as often as they were drawn, run by run."""
    every = []
    for genuine, impostor in replicate_weights(known, seed=0):
        rates = []
        for similarities in runs["similarities"]:
            mated, other = similarities[known.same], similarities[~known.same]
            threshold = threshold_at_fmr(np.repeat(other, impostor.astype(int)), fmr)
            rates.append(np.mean(np.repeat(mated, genuine.astype(int)) < threshold))
        every.append(rates)
    rates = np.array(every)
    chosen = np.random.default_rng(99).integers(len(runs), size=(20, *rates.shape))
    means = [np.take_along_axis(rates, draw, axis=1).mean(axis=1) for draw in chosen]
    low, high = np.percentile(np.concatenate(means), [2.5, 97.5])
    return float(low), float(high)


@pytest.mark.parametrize("named", [True, False])
def test_intervals_are_those_of_replicates_written_out(named: bool) -> None:
    known = made_trials(people=40, pairs=400, named=named)
    runs = run(SPREAD, known)
    at = row_of(runs, known, SPREAD)["fnmr_at_fmr"]["0.05"]
    low, high = written_out(known, runs, 0.05)
    # Its own threshold in every replicate makes it much wider than the errors alone would.
    bounds = wilson(at["errors_mean"], 200)
    assert high - low > 1.5 * (bounds[1] - bounds[0])
    assert at["ci_low"] == pytest.approx(low, abs=0.05)
    assert at["ci_high"] == pytest.approx(high, abs=0.05)
    assert at["interval"] == ("subject-bootstrap" if named else "pair-bootstrap")
