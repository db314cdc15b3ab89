from pathlib import Path
from typing import cast

import numpy as np
import pytest

from api.cli.inputs import further_faces
from api.settings import Settings
from models.pack import ModelPack
from verify.datasets import DatasetError


def read(file: Path) -> tuple[str, tuple[str, ...], np.ndarray]:
    """An archive needs neither the pack nor the settings."""
    faces = further_faces(
        file,
        cast("ModelPack", None),
        aligned=False,
        settings=cast("Settings", None),
        cache=None,
    )
    return faces.name, faces.people, faces.embeddings


def test_an_archive_names_people_by_their_folder(tmp_path: Path) -> None:
    rows = np.array([[3.0, 4.0], [0.0, 2.0]], dtype=np.float16)
    np.savez(tmp_path / "more.npz", paths=np.array(["ada/1.jpg", "2.jpg"]), descriptors=rows)
    name, people, embeddings = read(tmp_path / "more.npz")
    assert (name, people) == ("more.npz", ("ada", ""))
    np.testing.assert_allclose(embeddings, [[0.6, 0.8], [0.0, 1.0]], atol=1e-6)


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    (tmp_path / "more.npz").write_bytes(b"no archive")
    with pytest.raises(DatasetError, match=r"more\.npz"):
        read(tmp_path / "more.npz")
