"""The evaluation of a plan on any number of sets: embed, leave test people out, score, report."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from models.cache import EmbeddingCache
from templates.decoys import DecoyPool
from templates.space.lifting import Strategy
from verify.evaluation.acquisition import EmbeddedSet
from verify.evaluation.attributes import known_attributes, resembling
from verify.evaluation.embedder import Embedder, Progress
from verify.evaluation.evaluation import Evaluated, evaluate_set, prepare
from verify.evaluation.groups import by_group
from verify.evaluation.labels_file import Labels
from verify.evaluation.material import Material
from verify.evaluation.plan import EvaluationError, EvaluationPlan, units_of
from verify.evaluation.results import SetResult, SourceFacts, document
from verify.evaluation.rows import Json, cell_json, grouped
from verify.evaluation.timing import timings
from verify.evaluation.verification_set import VerificationSet

Note = Callable[[str], None]
SAME_PERSON = 0.4
"""Cosine from which a decoy counts as a person of the test set. Of 29.6 million pairs of photos of
two people of LFW 54 reach it, and some of those are one person under two names."""


def run_evaluation(
    plan: EvaluationPlan,
    embedder: Embedder,
    sets: Sequence[VerificationSet],
    sources: Sequence[SourceFacts],
    labels: Labels | None,
    *,
    cache: EmbeddingCache | None,
    executor: Executor,
    options: Json,
    note: Note,
    progress: Progress,
) -> Json:
    """Evaluate a plan; return the document of the results.

    Raises
    ------
    EvaluationError
        No photo of a set gave an embedding, or every decoy resembles one of its people.
    """
    embedded = [
        _embedded(embedder, pairs, cache=cache, note=note, progress=progress) for pairs in sets
    ]
    results: list[SetResult] = []
    groups: list[Json] = []
    summaries: list[Json] = []
    measured: list[Json] = []
    predicted: dict[str, int] = {}
    alike: dict[str, Json] = {}
    for faces in embedded:
        name = faces.pairs.name
        kept_sources = without_test_people(sources, faces, note=note)
        decoys = [facts.source for facts in kept_sources]
        attributes = None
        if Strategy.HYBRID_PLUS in plan.strategies:
            attributes, predicted[name] = known_attributes(faces, labels, decoys)
        material, facts, kept = prepare(
            faces.pairs, faces.acquired, attributes=attributes, sources=decoys
        )
        units = units_of(plan, decoys, n=material.n)
        with progress(f"evaluating {name}", len(units)) as advance:
            evaluated = evaluate_set(
                material, facts, kept, plan=plan, executor=executor, progress=advance
            )
        results.append(SetResult(faces, evaluated, kept_sources))
        if any(isinstance(source, DecoyPool) for source in decoys):
            alike[name] = resemblance(material)
        if labels is not None:
            entries, whole = group_rows(faces.pairs, evaluated, labels, seed=plan.seed)
            groups += entries
            summaries += whole
        if not measured:
            measured = timings(material, list(evaluated.source_of.items()))
    return document(
        plan,
        embedder.model,
        sources,
        results,
        options={**options, "predicted_attributes": predicted, "resemblance": alike},
        timings=measured,
        groups=groups,
        group_summaries=summaries,
    )


def _embedded(
    embedder: Embedder,
    pairs: VerificationSet,
    *,
    cache: EmbeddingCache | None,
    note: Note,
    progress: Progress,
) -> EmbeddedSet:
    faces = embedder.embed(pairs, cache=cache, progress=progress)
    failures = faces.acquired.failures
    if not len(faces.acquired.descriptors):
        raise EvaluationError(
            f"{pairs.name}: no photo gave an embedding, the first because of "
            f"{failures[0].code}; are these photos of faces, and does what was said of "
            "them (aligned, embeddings) fit?"
        )
    if failures:
        note(
            f"{pairs.name}: {len(failures)} of {len(pairs.pictures)} photos skipped; "
            "the results list them"
        )
    return faces


def without_test_people(
    sources: Sequence[SourceFacts], faces: EmbeddedSet, *, note: Note
) -> list[SourceFacts]:
    """Leave pool entries out that resemble a person of the set.

    Whoever was not acquired, or resembles their own photos less than ``SAME_PERSON``, stays in;
    ``resemblance`` says how many genuine pairs that concerns.

    Raises
    ------
    EvaluationError
        None is left.
    """
    kept = []
    for facts in sources:
        pool = facts.source
        if not isinstance(pool, DecoyPool):
            kept.append(facts)
            continue
        alike = resembling(pool, faces.acquired.descriptors, cosine=SAME_PERSON)
        if len(alike) == len(pool):
            raise EvaluationError(
                f"every face of {facts.file} resembles one of {faces.pairs.name}; build it from "
                "other people"
            )
        if len(alike):
            note(
                f"{faces.pairs.name}: {len(alike)} of {len(pool)} decoys resemble its people "
                f"(cosine {SAME_PERSON:g} or more) and are left out"
            )
            pool = pool.subset(np.setdiff1d(np.arange(len(pool)), alike))
        kept.append(replace(facts, source=pool, left_out=len(alike)))
    return kept


def resemblance(material: Material) -> Json:
    """State from which cosine decoys were left out, and which share of genuine pairs is below."""
    rows = material.descriptors
    first, second = rows[material.first[material.same]], rows[material.second[material.same]]
    cosines = np.einsum("ij,ij->i", first, second, dtype=np.float64)
    return {"cosine": SAME_PERSON, "genuine_below": float(np.mean(cosines < SAME_PERSON))}


def group_rows(
    pairs: VerificationSet, evaluated: Evaluated, labels: Labels, *, seed: int
) -> tuple[list[Json], list[Json]]:
    """Count errors by group at the threshold that holds for all, in every row and target.

    Returns
    -------
    groups, summaries
        Entries for each group, and one for all groups of an attribute together.
    """
    names = [picture.name for picture in pairs.pictures]
    groups: list[Json] = []
    summaries: list[Json] = []
    for attribute in labels.attributes:
        column = labels.column(attribute, names)
        first = [column[place] for place in pairs.first[evaluated.kept].tolist()]
        second = [column[place] for place in pairs.second[evaluated.kept].tolist()]
        for (cell, search), runs in grouped(evaluated.runs).items():
            if search != "exact":
                continue
            head = {"dataset": pairs.name, **cell_json(cell), "seed": seed}
            for place, errors in enumerate(runs[0].measures.at):
                report = by_group(
                    [run.similarities for run in runs],
                    evaluated.material.same,
                    first,
                    second,
                    attribute=attribute,
                    thresholds=[run.measures.at[place].threshold for run in runs],
                    target_fmr=errors.target,
                )
                groups += [{**head, **entry} for entry in report.json()]
                summaries.append({**head, **report.summary()})
    return groups, summaries
