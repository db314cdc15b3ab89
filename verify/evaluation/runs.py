"""One unit from start to end: similarities, figures, and the replicates of its intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.distances.blas import single_threaded
from verify.evaluation.material import Material
from verify.evaluation.measures import VerificationMeasures, measure
from verify.evaluation.resampling import (
    REPLICATES,
    OperatingPoints,
    fmr_grid,
    replicate_weights,
)
from verify.evaluation.scoring import Scores, score_unit
from verify.evaluation.units import Cell, Lifted, RawUnit, Search, Unit

Array64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """One run of one cell.

    Parameters
    ----------
    similarities : (P,) float64
    curve : (F,) float64
        FNMR at FMR ≤ each point of ``fmr_grid``.
    replicates : (R, T + F) float32
        FNMR at the resolvable targets and at the grid, in every replicate.
    """

    cell: Cell
    lifted: Lifted | None
    seed: int | None
    search: Search
    measures: VerificationMeasures
    similarities: Array64
    curve: Array64
    replicates: NDArray[np.float32]


def run_unit(
    material: Material,
    unit: Unit,
    *,
    targets: Sequence[float],
) -> list[Run]:
    """Compute the runs of a unit.

    Notes
    -----
    Products run on one thread each: workers share a machine, and several threads would round
    differently.
    """
    with single_threaded():
        searches: tuple[Search, ...] = (
            ("grid", "exact") if isinstance(unit, RawUnit) else ("exact",)
        )
        runs = [
            _run(material, unit, unit_scores, search, targets)
            for unit_scores in score_unit(material, unit)
            for search in searches
        ]
        _add_replicates(material, runs)
    return runs


def _run(
    material: Material,
    unit: Unit,
    scores: Scores,
    search: Search,
    targets: Sequence[float],
) -> Run:
    same = material.same
    measures = measure(scores.similarities, same, material.folds, targets=targets, search=search)
    points = OperatingPoints(scores.similarities[same], scores.similarities[~same])
    grid = fmr_grid(int(np.count_nonzero(~same)))
    return Run(
        cell=scores.cell,
        lifted=scores.lifted,
        seed=unit.seed,
        search=search,
        measures=measures,
        similarities=scores.similarities,
        curve=points.fnmr(grid),
        replicates=np.empty((REPLICATES, len(measures.at) + len(grid)), dtype=np.float32),
    )


def _add_replicates(material: Material, runs: Sequence[Run]) -> None:
    """Fill in the replicates: the same draws of people for all runs."""
    same = material.same
    points = [OperatingPoints(run.similarities[same], run.similarities[~same]) for run in runs]
    grid = fmr_grid(int(np.count_nonzero(~same)))
    wanted = [np.concatenate([[errors.target for errors in run.measures.at], grid]) for run in runs]
    for row, (genuine, impostor) in enumerate(replicate_weights(material, seed=0)):
        for run, run_points, fmrs in zip(runs, points, wanted, strict=True):
            run.replicates[row] = run_points.fnmr(fmrs, genuine=genuine, impostor=impostor)
