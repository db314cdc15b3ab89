"""Attributes predicted from a labelled pool, and pool entries that resemble faces of a set."""

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray

from templates.decoys import Attributes, DecoyPool
from templates.errors import DecoyError
from verify.evaluation import attributes
from verify.evaluation.attributes import predict_attributes, resembling_rows


def unit_rows(count: int, n: int = 16, seed: int = 0) -> NDArray[np.float32]:
    x = np.random.default_rng(seed).normal(size=(count, n))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def voted(cosines: NDArray[np.float64], labels: list[str | None], k: int) -> str:
    """The vote by hand: nearest labelled entries, ties to the first in the alphabet."""
    nearest = [i for i in np.argsort(-cosines) if labels[i] is not None][:k]
    votes = Counter(labels[i] for i in nearest)
    most = max(votes.values())
    return min(str(label) for label, count in votes.items() if count == most)


@pytest.mark.parametrize("k", [1, 4, 10])
def test_the_vote_is_that_of_the_nearest_entries(k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attributes, "NEIGHBOURS", k)
    rng = np.random.default_rng(4)
    genders = [str(g) for g in rng.choice(["Female", "Male"], 90)]
    races: list[str | None] = [str(r) for r in rng.choice(["Black", "Indian", "White"], 90)]
    races[:20] = [None] * 20
    entries, faces = unit_rows(90), unit_rows(40, seed=1)
    pool = DecoyPool(
        entries, labels=[Attributes(g, r) for g, r in zip(genders, races, strict=True)]
    )
    cosines = faces.astype(np.float64) @ entries.astype(np.float64).T
    assert predict_attributes(faces, pool) == [
        Attributes(voted(row, list(genders), k), voted(row, races, k)) for row in cosines
    ]


def test_a_pool_without_labels_is_refused() -> None:
    with pytest.raises(DecoyError, match="this one has no labels"):
        predict_attributes(unit_rows(2), DecoyPool(unit_rows(5)))


def test_entries_that_resemble_a_face_are_found_in_every_tile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(attributes, "_ROWS", 7)
    entries, faces = unit_rows(50), unit_rows(30, seed=1)
    cosines = (entries.astype(np.float64) @ faces.astype(np.float64).T).max(axis=1)
    # Between two observed maxima, so that no rounding decides.
    ordered = np.sort(cosines)
    for rank in (10, 25, 40):
        limit = float(ordered[rank - 1 : rank + 1].mean())
        found = resembling_rows(entries, faces, cosine=limit)
        assert found.dtype == np.int64
        assert found.tolist() == np.flatnonzero(cosines >= limit).tolist()
        assert len(found) == 50 - rank
    assert resembling_rows(entries, faces[:0], cosine=-1).size == 0
