"""The document of an evaluation of made-up people, as `veilface evaluate` writes it."""

import functools
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from models.extraction import Photo
from templates.decoys import DecoyGenerator
from tests.verify.evaluation.made_trials import N, made_trials
from verify.evaluation.embedding import EmbeddedSet
from verify.evaluation.experiment import SetResult, run_trials
from verify.evaluation.plan import EvaluationPlan, decoy_kind
from verify.evaluation.results import document
from verify.evaluation.sources import SourceFacts
from verify.evaluation.verification_set import VerificationSet

STRATEGIES = ("raw", "random", "adversarial", "hybrid")
PLAN = EvaluationPlan(STRATEGIES, dims=(2, 3), repeats=2, shared_decoys=True, targets=(0.1, 1e-4))


def verification_set(pairs: int = 100, people: int = 30) -> VerificationSet:
    known = made_trials(people=people, pairs=pairs)
    return VerificationSet(
        name="lfw",
        kind="lfw",
        pictures=tuple(Photo(f"{i}", b"") for i in range(2 * people)),
        first=known.first,
        second=known.second,
        same=known.same,
        folds=known.folds,
        people=tuple(f"p{i // 2}" for i in range(2 * people)),
        protocol_files=(("pairs.txt", "34" * 32),),
    )


def made_faces(rows: np.ndarray | None = None, **changes: Any) -> EmbeddedSet:
    given = {"pairs": verification_set(), "embeddings": made_trials().embeddings, "failures": ()}
    return EmbeddedSet(**given | {"rows": np.arange(60) if rows is None else rows} | changes)


@functools.cache
def _document() -> str:
    known = made_trials()
    sources = (known.sources[0], DecoyGenerator.fit(made_trials(people=200).embeddings))
    facts = [SourceFacts(one, f"{decoy_kind(one)}.veil", "cd" * 32, left_out=3) for one in sources]
    trials = replace(known, name="lfw", sources=sources)
    with ThreadPoolExecutor(2) as executor:
        runs = run_trials(trials, PLAN, executor=executor, progress=lambda _: None)
    faces = made_faces(aligned=True)
    model = {"n": N, "pack": "made_up", "embedder_sha256": "ab" * 32}
    results = [SetResult(faces, trials, facts, None)]
    made = document(PLAN, model, facts, runs, results, None, options={})
    return json.dumps(made, allow_nan=False)


def made_results() -> dict[str, Any]:
    """Return a document of its own, which the caller may change."""
    made: dict[str, Any] = json.loads(_document())
    return made


def row_of(results: dict[str, Any], **keys: Any) -> dict[str, Any]:
    """Return the one row that has these values."""
    (row,) = (one for one in results["rows"] if all(one[key] == keys[key] for key in keys))
    return row
