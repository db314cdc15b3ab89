"""The document of an evaluation: every figure with what it came from (docs/evaluation.md)."""

import platform
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from templates.contract.binding import Binding
from templates.decoys import DecoyPool
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from verify.evaluation.acquisition import EmbeddedSet
from verify.evaluation.cluster import SOFTWARE
from verify.evaluation.evaluation import Evaluated, Work
from verify.evaluation.material import Source
from verify.evaluation.plan import EvaluationPlan
from verify.evaluation.readers import notes
from verify.evaluation.rows import (
    Json,
    curve_json,
    grouped,
    refused_targets,
    row_json,
    run_json,
)
from verify.evaluation.scoring import decoy_kind, unit_layout
from verify.evaluation.units import Cell, Mode
from verify.tenfold import FOLDS

FORMAT = "veilface evaluation"
VERSION = 1
_LIBRARIES = ("numpy", "scipy", "onnxruntime", "opencv-python-headless")


@dataclass(frozen=True)
class Model:
    """Where descriptors came from.

    Parameters
    ----------
    facts
        For the reader: pack, detector, or file of embeddings with its SHA-256.
    embedder_sha256, preprocessing
        As in a contract; None where descriptors came from a file.
    """

    n: int
    facts: Json
    embedder_sha256: str | None = None
    preprocessing: Mapping[str, Any] | None = None

    def json(self) -> Json:
        """Everything as JSON."""
        known: Json = {"n": self.n, **self.facts}
        if self.embedder_sha256 is not None:
            known["embedder_sha256"] = self.embedder_sha256
            known["preprocessing"] = dict(self.preprocessing or {})
        return known


@dataclass(frozen=True, eq=False)
class SourceFacts:
    """A decoy source and the file it came from.

    Parameters
    ----------
    source
        As it is in the file; for a set, without the entries that resemble its people.
    """

    source: Source
    file: str
    sha256: str
    left_out: int = 0

    def json(self) -> Json:
        """Kind, id and size of the source."""
        pool = self.source if isinstance(self.source, DecoyPool) else None
        return {
            "kind": decoy_kind(self.source),
            "source_id": self.source.source_id,
            "entries": None if pool is None else len(pool),
            "labelled": pool is not None and pool.labelled,
        }


@dataclass(frozen=True, eq=False)
class SetResult:
    """One set and what was found on it; ``sources`` are the decoys as they were used on it."""

    faces: EmbeddedSet
    evaluated: Evaluated
    sources: Sequence[SourceFacts]

    def json(self) -> Json:
        """Counts, hashes and failures to acquire."""
        facts, pairs = self.evaluated.facts, self.faces.pairs
        return {
            "name": pairs.name,
            "kind": pairs.kind,
            "images": len(pairs.pictures),
            "pairs": len(pairs),
            "genuine": pairs.genuine,
            "impostor": pairs.impostor,
            "people": None if pairs.people is None else len(set(pairs.people)),
            "aligned": self.faces.aligned,
            "pictures_sha256": self.faces.pictures_sha256,
            "protocol_files": [list(entry) for entry in pairs.protocol_files],
            "failures": [
                {"image": failure.path.as_posix(), "code": failure.code, "reason": failure.reason}
                for failure in self.faces.acquired.failures
            ],
            "failed_genuine": facts.failed_genuine,
            "failed_impostor": facts.failed_impostor,
            "fta": facts.fta,
            "decoys": [{**source.json(), "left_out": source.left_out} for source in self.sources],
            "notes": notes(pairs),
        }


def software() -> Json:
    """Versions that figures depend on."""
    return {
        SOFTWARE: version(SOFTWARE),
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
    }


def document(
    plan: EvaluationPlan,
    model: Model,
    sources: Sequence[SourceFacts],
    sets: Sequence[SetResult],
    *,
    options: Json,
    timings: Sequence[Json],
    groups: Sequence[Json],
    group_summaries: Sequence[Json],
) -> Json:
    """Put everything together; ``rows`` and ``runs`` depend on seeds and inputs only.

    Times are apart, in ``timings`` and ``work``: they differ from run to run.
    """
    rows: list[Json] = []
    runs: list[Json] = []
    curves: list[Json] = []
    for result in sets:
        evaluated = result.evaluated
        for (cell, search), cell_runs in sorted(
            grouped(evaluated.runs).items(), key=lambda entry: _order(plan, *entry[0])
        ):
            place = evaluated.source_of[cell]
            source = None if place is None else evaluated.material.sources[place]
            rows.append(
                row_json(
                    cell,
                    search,
                    cell_runs,
                    evaluated.facts,
                    seed=plan.seed,
                    n=model.n,
                    source=source,
                    contract_id=contract_id(model, cell, source),
                )
            )
            runs += [run_json(run, result.faces.pairs.name) for run in cell_runs]
            if search == "exact":
                curves.append(curve_json(cell, cell_runs, evaluated.facts))
    return {
        "format": FORMAT,
        "version": VERSION,
        "software": software(),
        "seed": plan.seed,
        "repeats": plan.repeats,
        "options": {**asdict(plan), **options},
        "model": model.json(),
        "decoys": [
            {**source.json(), "file": source.file, "sha256": source.sha256} for source in sources
        ],
        "datasets": [result.json() for result in sets],
        "rows": rows,
        "groups": list(groups),
        "group_summaries": list(group_summaries),
        "timings": list(timings),
        "work": [
            {"dataset": result.faces.pairs.name, **entry}
            for result in sets
            for entry in _work(result.evaluated)
        ],
        "refused": refused_targets(
            plan.targets,
            {result.faces.pairs.name: result.evaluated.facts.impostor for result in sets},
        ),
        "runs": runs,
        "curves": curves,
        "folds": FOLDS,
    }


def _work(evaluated: Evaluated) -> list[Json]:
    """Seconds of a thread for each kind of unit: the mean over its seeds."""
    kinds: defaultdict[tuple[Any, ...], list[Work]] = defaultdict(list)
    for work in evaluated.work:
        cell, _ = unit_layout(work.unit, evaluated.material.sources)[0]
        kinds[cell.strategy, cell.decoys, cell.dim].append(work)
    return [
        {
            "strategy": strategy,
            "decoys": decoys,
            "dim": dim,
            "units": len(works),
            "seconds_mean": float(np.mean([work.seconds for work in works])),
        }
        for (strategy, decoys, dim), works in kinds.items()
    ]


def contract_id(model: Model, cell: Cell, source: Source | None) -> str | None:
    """Contract that templates of a cell belong to; None where none can be made.

    A contract binds an embedder and a decoy source, so raw descriptors, random lifting and
    descriptors from a file have none.
    """
    if source is None or model.embedder_sha256 is None or model.preprocessing is None:
        return None
    return Binding(
        embedder_sha256=model.embedder_sha256,
        preprocessing=model.preprocessing,
        n=model.n,
        axes=source.k,
        strategy=Strategy(cell.strategy),
        m=cell.dim,
        decoy_source_id=source.source_id,
        rotation_version=ROTATION_VERSION,
    ).contract_id


def _order(plan: EvaluationPlan, cell: Cell, search: str) -> tuple[Any, ...]:
    """Rows as the plan names them, raw first."""
    modes = list(Mode)
    return (
        modes.index(cell.mode),
        plan.strategies.index(cell.strategy),
        cell.decoys or "",
        cell.dim,
        cell.metric,
        search != "grid",
    )
