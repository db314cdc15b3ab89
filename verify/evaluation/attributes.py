"""What a labelled decoy pool tells about the faces of a set that has no labels or shares people."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from templates.decoys.pool import DecoyPool
from templates.decoys.source import Attributes, DecoySource
from templates.errors import DecoyError
from verify.evaluation.embedding import EmbeddedSet
from verify.evaluation.labels_file import Labels
from verify.evaluation.plan import EvaluationError

NEIGHBOURS = 10
"""All entries where fewer have a label."""
_ROWS = 1024


def predict_attributes(embeddings: NDArray[np.float32], pool: DecoyPool) -> list[Attributes]:
    """Predict gender and race by the vote of the nearest entries of a labelled pool.

    hybrid+ needs the attributes of the faces it lifts; the paper predicts those of unlabelled
    faces. The vote is taken for each attribute by itself (:func:`voted`).
    """
    entries, labels = pool.entries
    if labels is None:
        raise DecoyError(
            "attributes are predicted from a labelled decoy pool, and this one has no labels; "
            "build the pool from a folder with FairFace labels"
        )
    genders = voted(embeddings, entries, [label.gender for label in labels])
    races = voted(embeddings, entries, [label.race for label in labels])
    return [Attributes(gender, race) for gender, race in zip(genders, races, strict=True)]


def known_attributes(
    faces: EmbeddedSet, labels: Labels | None, decoys: Sequence[DecoySource]
) -> tuple[list[Attributes], int]:
    """Gender and race of every row, as labelled or else predicted, and how many were predicted."""
    pool = next(source for source in decoys if isinstance(source, DecoyPool) and source.labelled)
    entries = pool.entries[1] or ()
    vocabulary = {
        "gender": {label.gender for label in entries if label.gender is not None},
        "race": {label.race for label in entries if label.race is not None},
    }
    attributes = predict_attributes(faces.embeddings, pool)
    predicted = len(attributes)
    for name, row in zip(faces.pairs.names, faces.rows.tolist(), strict=True):
        own = {} if labels is None or row < 0 else labels.find(name)
        if not vocabulary.keys() <= own.keys():
            continue
        for attribute, values in vocabulary.items():
            if own[attribute] not in values:
                raise EvaluationError(
                    f"the label file says {attribute} {own[attribute]!r} of {name}; "
                    f"the decoy pool knows {', '.join(sorted(values))}: hybrid+ needs one "
                    "vocabulary for both"
                )
        attributes[row] = Attributes(gender=own["gender"], race=own["race"])
        predicted -= 1
    return attributes, predicted


def voted(
    embeddings: NDArray[np.float32],
    entries: NDArray[np.float32],
    labels: Sequence[str | None],
) -> list[str | None]:
    """Give each face the label that most of its nearest labelled entries have; None without any.

    Equal votes go to the label that comes first in the alphabet.
    """
    known = [i for i, label in enumerate(labels) if label is not None]
    if not known or not len(embeddings):
        return [None] * len(embeddings)
    names, number_of = np.unique([str(labels[i]) for i in known], return_inverse=True)
    nearest_of, k = entries[known].T, min(NEIGHBOURS, len(known))
    chosen: list[str | None] = []
    for start in range(0, len(embeddings), _ROWS):
        # Of unit rows, the nearest by Euclidean distance are the nearest by angle.
        cosines = embeddings[start : start + _ROWS] @ nearest_of
        nearest = np.argpartition(-cosines, k - 1, axis=1)[:, :k]
        votes = (number_of[nearest][:, :, None] == np.arange(len(names))).sum(axis=1)
        chosen += [str(name) for name in names[votes.argmax(axis=1)]]
    return chosen


def resembling_rows(
    rows: NDArray[np.float32], others: NDArray[np.float32], *, cosine: float
) -> NDArray[np.int64]:
    """Find the rows that have a cosine of at least ``cosine`` with any of the others, ascending."""
    resembles = np.zeros(len(rows), dtype=np.bool_)
    for start in range(0, len(rows), _ROWS):
        tile = rows[start : start + _ROWS]
        for other in range(0, len(others), _ROWS):
            cosines = tile @ others[other : other + _ROWS].T
            resembles[start : start + _ROWS] |= (cosines >= np.float64(cosine)).any(axis=1)
    return np.flatnonzero(resembles).astype(np.int64)
