"""Faces of which nobody knows who they are."""

from pathlib import Path

import numpy as np

from models.extraction import Extraction
from tests.verify.population import N, unit
from verify.preparation import without_lookalikes


def test_of_faces_that_look_alike_the_first_stays() -> None:
    rows = unit(np.random.default_rng(8).normal(size=(4, N)))
    rows[2] = unit(rows[0] + 0.5 * rows[3])
    paths = [Path(f"{number}.jpg") for number in range(4)]
    kept = without_lookalikes(Extraction(rows, paths, [], cached=0))
    assert [path.name for path in kept.paths] == ["0.jpg", "1.jpg", "3.jpg"]
    np.testing.assert_array_equal(kept.embeddings, rows[[0, 1, 3]])
