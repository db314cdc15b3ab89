"""The decoys of an evaluation, and the people of its sets among them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from templates.decoys import DecoyPool
from verify.evaluation.attributes import resembling_rows
from verify.evaluation.embedding import EmbeddedSet
from verify.evaluation.plan import EvaluationError, Json, Source, decoy_kind

Note = Callable[[str], None]
SAME_PERSON = 0.4
"""Cosine from which a decoy counts as a person of the test set. Of 29.6 million pairs of photos of
two people of LFW 54 reach it, and some of those are one person under two names."""


@dataclass(frozen=True, eq=False)
class SourceFacts:
    """A decoy source and the file it came from."""

    source: Source  # for a set, without the entries that resemble its people
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


def without_test_people(
    sources: Sequence[SourceFacts], faces: EmbeddedSet, *, note: Note
) -> list[SourceFacts]:
    """Leave pool entries out that resemble a person of the set.

    A person who was not acquired, or resembles their own photos less than ``SAME_PERSON``, stays
    in.
    """
    kept = []
    for facts in sources:
        pool = facts.source
        if not isinstance(pool, DecoyPool):
            kept.append(facts)
            continue
        alike = resembling_rows(pool.entries[0], faces.embeddings, cosine=SAME_PERSON)
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
