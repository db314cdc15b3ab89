"""Sets of presentations whose scores a test states."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from models.extraction import Failure
from verify.evaluation.liveness.presentations import Presentation, PresentationSet
from verify.evaluation.liveness.scores import ScoredSet

Stated = tuple[str | None, str | None, float | None]
"""Species (None: live), subject, score (None: no face)."""


def scored_set(stated: Sequence[Stated], embeddings: np.ndarray | None = None) -> ScoredSet:
    presentations = tuple(
        Presentation(Path(f"{row}.png"), f"{row}.png", species, subject)
        for row, (species, subject, _) in enumerate(stated)
    )
    scores = np.array([np.nan if score is None else score for _, _, score in stated])
    failures = tuple(
        Failure(one.path, "no_face", "No face was found.")
        for one, score in zip(presentations, scores, strict=True)
        if np.isnan(score)
    )
    if embeddings is None:
        embeddings = np.zeros((len(stated), 4), np.float32)
    return ScoredSet(PresentationSet("booth", presentations), scores, embeddings, failures)
