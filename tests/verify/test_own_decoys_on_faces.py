"""Decoys of the people themselves, on descriptors of real faces of several kinds."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from templates.decoys import DecoyGenerator
from templates.errors import ContractError
from verify.own_decoys import require_others

KINDS = ("lfw_rest", "fairface_more", "utkface", "allagefaces")


@pytest.fixture(scope="module")
def faces(shared_data: Path) -> dict[str, dict[str, NDArray[np.float32]]]:
    """By embedder and kind: unit rows in random order."""
    found: dict[str, dict[str, NDArray[np.float32]]] = {}
    for embedder, kind in product(("emb_mbf", "emb_y1"), KINDS):
        file = shared_data / "embeddings" / f"{kind}.npz"
        if not file.is_file():
            pytest.skip(f"{file.name} is not among the shared data")
        with np.load(file) as kept:
            rows = kept[embedder].astype(np.float32)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        order = np.random.default_rng(0).permutation(len(rows))
        found.setdefault(embedder, {})[kind] = rows[order]
    return found


def refused(source: DecoyGenerator, rows: NDArray[np.float32]) -> bool:
    try:
        require_others(source, rows, [str(row) for row in range(len(rows))])
    except ContractError:
        return True
    return False


@pytest.mark.long
@pytest.mark.parametrize("embedder", ["emb_mbf", "emb_y1"])
@pytest.mark.parametrize("fitted", [150, 600, 2500])
@pytest.mark.parametrize("kind", KINDS)
def test_only_the_people_of_the_fit_are_refused(
    faces: dict[str, dict[str, NDArray[np.float32]]], embedder: str, fitted: int, kind: str
) -> None:
    rows = faces[embedder][kind]
    source = DecoyGenerator.fit(rows[:fitted])
    assert refused(source, rows[:fitted])
    for other, several in product(KINDS, (80, 400)):
        start = fitted if other == kind else 0
        assert not refused(source, faces[embedder][other][start : start + several]), other
