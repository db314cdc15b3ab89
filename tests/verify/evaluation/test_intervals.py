"""The intervals of rows and the bands of curves, against replicates that are written out."""

from pathlib import Path

import numpy as np
import pytest

from templates.distances import Metric
from templates.space.lifting import Strategy
from tests.verify.evaluation.materials import material
from verify.evaluation.material import Material
from verify.evaluation.resampling import fmr_grid, replicate_weights
from verify.evaluation.rows import SetFacts, curve_json, grouped, row_json
from verify.evaluation.runs import Run, run_unit
from verify.evaluation.units import LiftUnit, Mode
from verify.metrics import threshold_at_fmr, wilson

TARGET = 0.05


def runs_of(known: Material, seeds: range) -> list[Run]:
    """Runs of one cell whose lifts differ much, so that the draw of runs shows."""
    units = [
        LiftUnit(Strategy.ADVERSARIAL, 2, 0, True, (Mode.SUBSPACE,), (Metric.EUCLIDEAN,), 9, seed)
        for seed in seeds
    ]
    runs = [run for unit in units for run in run_unit(known, unit, targets=(TARGET,))]
    (found,) = grouped(runs).values()
    return found


def written_out(known: Material, runs: list[Run], fmr: float) -> tuple[float, float]:
    """95 % interval of the mean FNMR: trials repeated as often as they were drawn, run by run."""
    every = []
    for genuine, impostor in replicate_weights(known, seed=0):
        rates = []
        for run in runs:
            mated, other = run.similarities[known.same], run.similarities[~known.same]
            repeated = np.repeat(other, impostor.astype(int))
            threshold = threshold_at_fmr(repeated, fmr)
            rates.append(np.mean(np.repeat(mated, genuine.astype(int)) < threshold))
        every.append(rates)
    rates = np.array(every)
    chosen = np.random.default_rng(99).integers(len(runs), size=(20, *rates.shape))
    means = [np.take_along_axis(rates, draw, axis=1).mean(axis=1) for draw in chosen]
    low, high = np.percentile(np.concatenate(means), [2.5, 97.5])
    return float(low), float(high)


@pytest.mark.parametrize("named", [True, False])
def test_intervals_are_those_of_replicates_written_out(named: bool) -> None:
    known = material(people=40, pairs=400, spread=0.15, named=named)
    runs = runs_of(known, range(4))
    facts = SetFacts("made", 200, 200, 0, 0, 0.0, names_people=named)
    row = row_json(runs[0].cell, "exact", runs, facts, seed=0, n=24, source=None, contract_id=None)
    at = row["fnmr_at_fmr"]["0.05"]
    low, high = written_out(known, runs, TARGET)
    # Its own threshold in every replicate makes it much wider than the errors alone would.
    bounds = wilson(at["errors_mean"], 200)
    assert high - low > 1.5 * (bounds[1] - bounds[0])
    assert at["ci_low"] == pytest.approx(low, abs=0.05)
    assert at["ci_high"] == pytest.approx(high, abs=0.05)
    assert at["interval"] == ("subject-bootstrap" if named else "pair-bootstrap")


def test_the_band_of_a_curve_is_that_of_replicates_written_out() -> None:
    known = material(people=40, pairs=400, spread=0.15)
    runs = runs_of(known, range(4))
    facts = SetFacts("made", 200, 200, 0, 0, 0.0, names_people=True)
    curve = curve_json(runs[0].cell, runs, facts)
    grid = fmr_grid(200)
    np.testing.assert_allclose(curve["fmr"], grid)
    for place in (10, 25, 40):
        low, high = written_out(known, runs, grid[place])
        assert curve["low"][place] == pytest.approx(low, abs=0.05)
        assert curve["high"][place] == pytest.approx(high, abs=0.05)


def test_one_run_has_the_spread_of_people_only(tmp_path: Path) -> None:
    known = material(people=40, pairs=400, spread=0.15)
    (run,) = runs_of(known, range(1))
    facts = SetFacts("made", 200, 200, 0, 0, 0.0, names_people=True)
    curve = curve_json(run.cell, [run], facts)
    low, high = np.percentile(run.replicates[:, 1:], [2.5, 97.5], axis=0)
    np.testing.assert_allclose(curve["low"], low, atol=1e-6)
    np.testing.assert_allclose(curve["high"], high, atol=1e-6)
