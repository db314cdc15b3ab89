"""The experiment: embed each set, leave its people out of the decoys, compare all pairs, measure.

Every run of every way of comparing is one line of one data frame; the results are read off it.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from models.cache import EmbeddingCache
from templates.decoys import Attributes
from templates.distances.blas import single_threaded
from templates.space.embedding import normalised
from templates.space.lifting import Strategy
from verify.evaluation.attributes import known_attributes
from verify.evaluation.comparison import Trials, compare
from verify.evaluation.embedding import Advance, EmbeddedSet, Embedder, Progress
from verify.evaluation.groups import by_group
from verify.evaluation.intervals import REPLICATES, OperatingPoints, fmr_grid, replicate_weights
from verify.evaluation.labels_file import Labels
from verify.evaluation.measures import measure
from verify.evaluation.plan import (
    EvaluationError,
    EvaluationPlan,
    Json,
    Mode,
    Source,
    Unit,
    units_of,
)
from verify.evaluation.sources import Note, SourceFacts, without_test_people
from verify.evaluation.verification_set import VerificationSet, require_both_classes

CELL = ["dataset", "strategy", "decoys", "shared_decoys", "dim", "mode", "metric"]
"""What names a way of comparing; curves and groups have these."""
ROW = [*CELL, "threshold_search"]
"""What names a row of the results, which is the mean of its runs."""
ARRAYS = ["similarities", "curve", "replicates"]
"""Columns of a run that no document has."""


@dataclass(frozen=True, eq=False)
class SetResult:
    """One set, the pairs that were compared, and the decoys as they were used on it."""

    faces: EmbeddedSet
    trials: Trials
    sources: Sequence[SourceFacts]
    predicted: int | None  # photos whose attributes were predicted; None without hybrid+


def evaluate(
    plan: EvaluationPlan,
    embedder: Embedder,
    sets: Sequence[VerificationSet],
    sources: Sequence[SourceFacts],
    labels: Labels | None,
    *,
    cache: EmbeddingCache | None,
    executor: Executor,
    note: Note,
    progress: Progress,
) -> tuple[pd.DataFrame, list[SetResult]]:
    """Evaluate a plan on any number of sets; returns the runs of :func:`run_trials` and the rest.

    The executor computes the units of work: threads, processes or a cluster.
    """
    embedded = [
        _embedded(embedder, pairs, cache=cache, note=note, progress=progress) for pairs in sets
    ]
    frames, results = [], []
    for faces in embedded:
        own = without_test_people(sources, faces, note=note)
        decoys = tuple(facts.source for facts in own)
        attributes, predicted = None, None
        if Strategy.HYBRID_PLUS in plan.strategies:
            attributes, predicted = known_attributes(faces, labels, decoys)
        trials = trials_of(faces, attributes=attributes, sources=decoys)
        steps = len(units_of(plan, decoys, n=trials.embeddings.shape[1]))
        with progress(f"evaluating {faces.pairs.name}", steps) as advance:
            frames.append(run_trials(trials, plan, executor=executor, progress=advance))
        results.append(SetResult(faces, trials, own, predicted))
    return pd.concat(frames, ignore_index=True), results


def _embedded(
    embedder: Embedder,
    pairs: VerificationSet,
    *,
    cache: EmbeddingCache | None,
    note: Note,
    progress: Progress,
) -> EmbeddedSet:
    faces = embedder.embed(pairs, cache=cache, progress=progress)
    if not len(faces.embeddings):
        raise EvaluationError(
            f"{pairs.name}: no photo gave an embedding, the first because of "
            f"{faces.failures[0].code}; are these photos of faces, and does what was said of "
            "them (aligned, embeddings) fit?"
        )
    if faces.failures:
        note(
            f"{pairs.name}: {len(faces.failures)} of {len(pairs.pictures)} photos skipped; "
            "the results list them"
        )
    return faces if pairs.templates is None else averaged(faces, pairs.templates)


def averaged(faces: EmbeddedSet, templates: Sequence[Sequence[int]]) -> EmbeddedSet:
    """Replace the embeddings of photos by those of templates: the mean of their photos, scaled.

    Photos that failed are left out of the mean; a template of such photos alone has none.
    """
    acquired = [[row for row in faces.rows[list(photos)] if row >= 0] for photos in templates]
    present = np.array([bool(rows) for rows in acquired])

    sums = [faces.embeddings[rows].sum(axis=0, dtype=np.float64) for rows in acquired if rows]
    return replace(
        faces,
        embeddings=normalised(np.stack(sums)).astype(np.float32),
        rows=np.where(present, np.cumsum(present) - 1, -1),
    )


def trials_of(
    faces: EmbeddedSet, *, attributes: Sequence[Attributes] | None, sources: tuple[Source, ...]
) -> Trials:
    """Take the pairs of which both photos gave an embedding; the others are counted."""
    pairs = faces.pairs
    first, second = faces.rows[pairs.first], faces.rows[pairs.second]
    kept = np.flatnonzero((first >= 0) & (second >= 0))
    same = pairs.same[kept]
    folds = None if pairs.folds is None else pairs.folds[kept]
    require_both_classes(
        f"{pairs.name}, without the {len(pairs) - len(kept)} pairs that lack an embedding,",
        same,
        folds,
    )
    people = None
    if pairs.people is not None:
        numbers = np.unique(np.asarray(pairs.people, dtype=np.str_), return_inverse=True)[1]
        people = np.stack([numbers[pairs.first[kept]], numbers[pairs.second[kept]]])
    genuine = int(np.count_nonzero(same))
    return Trials(
        name=pairs.name,
        embeddings=faces.embeddings,
        first=first[kept],
        second=second[kept],
        same=same,
        folds=folds,
        people=people,
        attributes=attributes,
        sources=sources,
        kept=kept,
        failed_genuine=pairs.genuine - genuine,
        failed_impostor=pairs.impostor - (len(same) - genuine),
        fta=float(np.mean(faces.rows < 0)),
    )


def run_trials(
    trials: Trials, plan: EvaluationPlan, *, executor: Executor, progress: Advance
) -> pd.DataFrame:
    """Compute all units of a plan on one set; ``progress`` counts them.

    Returns one line for each way of comparing, seed, lifted side and threshold search, in the order
    of the plan and not of arrival. The columns are those of ``ROW``, ``seed`` and ``lifted``, what
    :func:`measure` returns, and ``similarities`` (P,), ``curve`` (F,), the FNMR at each FMR of
    ``fmr_grid``, and ``replicates`` (R, targets + F), the FNMR of resampled pairs.
    """
    units = units_of(plan, trials.sources, n=trials.embeddings.shape[1])
    records: list[Json] = []
    for unit_records in executor.map(partial(run_unit, trials, plan), units):
        records += unit_records
        progress(1)
    modes = list(Mode)
    records.sort(
        key=lambda run: (
            modes.index(run["mode"]),
            plan.strategies.index(run["strategy"]),
            run["decoys"] or "",
            run["dim"],
            run["metric"],
            run["threshold_search"] != "grid",
            run["seed"] or 0,
            run["lifted"] or "",
        )
    )
    return pd.DataFrame(records, dtype=object)


def run_unit(trials: Trials, plan: EvaluationPlan, unit: Unit) -> list[Json]:
    """Compute the runs of one unit of work.

    Products run on one thread each: several would round differently on another machine.
    """
    with single_threaded():
        searches = ("grid", "exact") if unit.raw and trials.folds is not None else ("exact",)
        runs: list[Json] = [
            {
                "dataset": trials.name,
                **names,
                **measure(
                    similarities, trials.same, trials.folds, targets=plan.targets, search=search
                ),
                "similarities": similarities,
            }
            for names, similarities in compare(trials, unit, plan)
            for search in searches
        ]
        _add_curves(trials, runs)
    return runs


def _add_curves(trials: Trials, runs: Sequence[Json]) -> None:
    """Add curves and replicates: the same draws of people for all runs."""
    same, grid = trials.same, fmr_grid(trials.impostor)
    points, wanted = [], []
    for run in runs:
        similarities = run["similarities"]
        points.append(OperatingPoints(similarities[same], similarities[~same]))
        wanted.append(np.concatenate([[*map(float, run["fnmr_at_fmr"])], grid]))
        run["curve"] = points[-1].fnmr(grid)
        run["replicates"] = np.empty((REPLICATES, len(wanted[-1])), dtype=np.float32)
    for row, (genuine, impostor) in enumerate(replicate_weights(trials, seed=0)):
        for run, run_points, fmrs in zip(runs, points, wanted, strict=True):
            run["replicates"][row] = run_points.fnmr(fmrs, genuine=genuine, impostor=impostor)


def group_rates(
    runs: pd.DataFrame, results: Sequence[SetResult], labels: Labels, plan: EvaluationPlan
) -> tuple[list[Json], list[Json]]:
    """Count errors by group at the threshold that holds for all, in every row and target."""
    groups: list[Json] = []
    summaries: list[Json] = []
    exact = runs[runs["threshold_search"] == "exact"]
    for result in results:
        pairs, trials = result.faces.pairs, result.trials
        own = exact[exact["dataset"] == pairs.name]
        for attribute in labels.attributes:
            column = labels.column(attribute, pairs.names)
            first = [column[place] for place in pairs.first[trials.kept].tolist()]
            second = [column[place] for place in pairs.second[trials.kept].tolist()]
            for _, lines in own.groupby(CELL, sort=False, dropna=False):
                head = {**lines.iloc[0][CELL].to_dict(), "seed": plan.seed}
                for target in lines["fnmr_at_fmr"].iloc[0]:
                    entries, summary = by_group(
                        list(lines["similarities"]),
                        trials.same,
                        first,
                        second,
                        attribute=attribute,
                        thresholds=[at[target]["threshold"] for at in lines["fnmr_at_fmr"]],
                        target_fmr=float(target),
                    )
                    groups += [{**head, **entry} for entry in entries]
                    summaries.append({**head, **summary})
    return groups, summaries
