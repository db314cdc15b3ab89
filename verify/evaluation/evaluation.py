"""The evaluation of one set: all units, wherever they run, put together in a fixed order."""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from templates.decoys import Attributes
from verify.evaluation.acquisition import Acquired
from verify.evaluation.backends import SOFTWARE, Backend, spread
from verify.evaluation.checkpoints import Checkpoints
from verify.evaluation.material import Material, Source
from verify.evaluation.plan import EvaluationPlan, units_of
from verify.evaluation.rows import SetFacts
from verify.evaluation.runs import Run, run_unit
from verify.evaluation.scoring import SCORING_VERSION, unit_layout
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
    resumed: bool


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
    out: Path,
    backend: Backend,
    progress: Advance,
) -> Evaluated:
    """Run all units of a plan on one set; those found in ``out`` are not computed again.

    Parameters
    ----------
    progress
        Called with the number of units done since the last call.
    """
    units = units_of(plan, material.sources, n=material.n)
    checkpoints = Checkpoints(
        out,
        {
            "software": version(SOFTWARE),
            "numpy": version("numpy"),
            "scoring": SCORING_VERSION,
            "material": _digest(material),
        },
        sources=[source.source_id for source in material.sources],
        attributes=material.attributes or (),
        flipped=material.flipped,
    )
    layouts = [unit_layout(unit, material.sources) for unit in units]
    known = [
        checkpoints.load(unit, columns=len(layout), pairs=len(material))
        for unit, layout in zip(units, layouts, strict=True)
    ]
    shared = (material, plan.targets)
    runs_of_unit: list[list[Run]] = [[] for _ in units]
    seconds = [0.0 for _ in units]
    for index, (runs, taken) in spread(backend, _run, shared, zip(units, known, strict=True)):
        if known[index] is None:
            checkpoints.save(units[index], runs)
        runs_of_unit[index], seconds[index] = runs, taken
        progress(1)
    source_of = {
        cell: unit.source if isinstance(unit, LiftUnit) else None
        for unit, layout in zip(units, layouts, strict=True)
        for cell, _ in layout
    }
    work = [
        Work(unit, taken, resumed=column is not None)
        for unit, taken, column in zip(units, seconds, known, strict=True)
    ]
    runs = [run for unit_runs in runs_of_unit for run in unit_runs]
    return Evaluated(facts, material, kept, runs, source_of, work)


def _run(
    shared: tuple[Material, Sequence[float]], item: tuple[Unit, list[NDArray[np.float64]] | None]
) -> tuple[list[Run], float]:
    material, targets = shared
    unit, known = item
    start = time.perf_counter()
    runs = run_unit(material, unit, targets=targets, known=known)
    return runs, time.perf_counter() - start


def _digest(material: Material) -> str:
    """Name what is compared, descriptors included: whatever changes them, changes it."""
    whole = hashlib.sha256()
    pairs = (material.first, material.second, material.same, material.folds)
    for part in (material.descriptors, *pairs):
        data = np.ascontiguousarray(part).tobytes()
        whole.update(len(data).to_bytes(8, "big") + data)
    return whole.hexdigest()
