"""The evaluation of one set: all units, wherever they run, put together in a fixed order."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from templates.decoys import Attributes
from verify.evaluation.acquisition import Acquired
from verify.evaluation.material import Material, Source
from verify.evaluation.plan import EvaluationPlan, units_of
from verify.evaluation.rows import SetFacts
from verify.evaluation.runs import Run, run_unit
from verify.evaluation.scoring import unit_layout
from verify.evaluation.units import LiftUnit, Unit
from verify.evaluation.verification_set import VerificationSet, require_both_classes

Advance = Callable[[int], None]


@dataclass(frozen=True, eq=False, repr=False)
class Evaluated:
    """All runs of one set.

    Parameters
    ----------
    kept : (P,) int64
        Pairs of the set that were compared, as positions in it.
    source_of
        Position of the decoy source of each lifted cell.
    """

    facts: SetFacts
    material: Material
    kept: NDArray[np.int64]
    runs: list[Run]
    source_of: dict[Any, int | None]
    work: list["Work"]


@dataclass(frozen=True)
class Work:
    """What a unit took.

    Parameters
    ----------
    seconds
        Of one thread, from the descriptors to the figures.
    """

    unit: Unit
    seconds: float


def prepare(
    pairs: VerificationSet,
    acquired: Acquired,
    *,
    attributes: Sequence[Attributes] | None,
    sources: Sequence[Source],
) -> tuple[Material, SetFacts, NDArray[np.int64]]:
    """Take the pairs of which both photos gave a descriptor; the others are counted.

    Raises
    ------
    DatasetError
        Too few pairs are left.
    """
    first, second = acquired.rows[pairs.first], acquired.rows[pairs.second]
    kept = np.flatnonzero((first >= 0) & (second >= 0))
    same = pairs.same[kept]
    require_both_classes(
        f"{pairs.name}, without the {len(pairs) - len(kept)} pairs that lack an embedding,",
        same,
        pairs.folds[kept],
    )
    genuine = int(np.count_nonzero(same))
    impostor = len(same) - genuine
    facts = SetFacts(
        name=pairs.name,
        genuine=genuine,
        impostor=impostor,
        failed_genuine=pairs.genuine - genuine,
        failed_impostor=pairs.impostor - impostor,
        fta=len(acquired.failures) / len(acquired.rows),
        names_people=pairs.people is not None,
    )
    people = None
    if pairs.people is not None:
        _, numbers = np.unique(np.asarray(pairs.people, dtype=np.str_), return_inverse=True)
        people = np.stack([numbers[pairs.first[kept]], numbers[pairs.second[kept]]])
    material = Material(
        descriptors=acquired.descriptors,
        flipped=acquired.mirrored,
        first=first[kept],
        second=second[kept],
        same=same,
        folds=pairs.folds[kept],
        people=people,
        attributes=attributes,
        sources=tuple(sources),
    )
    return material, facts, kept


def evaluate_set(
    material: Material,
    facts: SetFacts,
    kept: NDArray[np.int64],
    *,
    plan: EvaluationPlan,
    executor: Executor,
    progress: Advance,
) -> Evaluated:
    """Compute all units of a plan on one set.

    Parameters
    ----------
    executor
        Where units are computed: threads, processes or a cluster.
    progress
        Called with the number of units done since the last call.
    """
    units = units_of(plan, material.sources, n=material.n)
    runs: list[Run] = []
    work: list[Work] = []
    results = executor.map(partial(_run, material, plan.targets), units)
    for unit, (unit_runs, seconds) in zip(units, results, strict=True):
        runs += unit_runs
        work.append(Work(unit, seconds))
        progress(1)
    source_of = {
        cell: unit.source if isinstance(unit, LiftUnit) else None
        for unit in units
        for cell, _ in unit_layout(unit, material.sources)
    }
    return Evaluated(facts, material, kept, runs, source_of, work)


def _run(material: Material, targets: Sequence[float], unit: Unit) -> tuple[list[Run], float]:
    start = time.perf_counter()
    runs = run_unit(material, unit, targets=targets)
    return runs, time.perf_counter() - start
