"""Descriptors from elsewhere, and their photos."""

import hashlib
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from models.extraction import Photo
from verify import DatasetError
from verify.evaluation.embeddings_file import EmbeddingsFile, match, read_embeddings
from verify.evaluation.verification_set import VerificationSet

pytestmark = pytest.mark.usefixtures("in_this_process")


def rows_of(count: int, n: int = 8) -> np.ndarray:
    return np.random.default_rng(count).normal(size=(count, n))


def embeddings(paths: Sequence[str]) -> EmbeddingsFile:
    return EmbeddingsFile(tuple(paths), np.eye(len(paths), dtype=np.float32), "0" * 64)


def benchmark(kind: str, names: Sequence[str]) -> VerificationSet:
    none = np.zeros(0, dtype=np.int64)
    pictures = tuple(Photo(name, b"") for name in names)
    return VerificationSet(kind, kind, pictures, none, none, none.astype(bool), none)


@pytest.mark.parametrize("dtype", ["f2", "<f4", ">f4", "f8"])
@pytest.mark.parametrize("compressed", [False, True])
def test_rows_become_unit(tmp_path: Path, dtype: str, compressed: bool) -> None:
    rows = (3 * rows_of(5)).astype(dtype)
    paths = np.array([f"a/{i}.jpg" for i in range(5)])
    file = tmp_path / "e.npz"
    (np.savez_compressed if compressed else np.savez)(
        file, paths=paths, descriptors=np.asfortranarray(rows), extra=np.zeros(3)
    )
    read = read_embeddings(file)
    assert read.paths == tuple(paths.tolist())
    assert read.sha256 == hashlib.sha256(file.read_bytes()).hexdigest()
    wide = rows.astype(np.float64)
    expected = wide / np.linalg.norm(wide, axis=1, keepdims=True)
    np.testing.assert_allclose(read.embeddings, expected, atol=1e-7)
    assert read.embeddings.dtype == np.float32
    assert read.embeddings.flags.c_contiguous


PATHS = np.array(["a", "b", "c"])
ROWS = np.eye(3, 4)
NAN = np.where(np.eye(3, 4) == 1, np.nan, 1.0)
ZERO = ROWS * np.array([[1], [0], [1]])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"paths": PATHS}, "no array descriptors, only 'paths'"),
        ({"descriptors": ROWS}, "no array paths"),
        ({"paths": PATHS[:2], "descriptors": ROWS}, "expected .N,. and .N, n."),
        ({"paths": PATHS, "descriptors": ROWS[0]}, "expected .N,. and .N, n."),
        ({"paths": PATHS[:0], "descriptors": ROWS[:0]}, "expected .N,."),
        ({"paths": PATHS, "descriptors": ROWS.astype(int)}, "descriptors of type int64"),
        (
            {"paths": PATHS, "descriptors": ROWS.astype(complex)},
            "descriptors of type complex128",
        ),
        ({"paths": PATHS.astype("S"), "descriptors": ROWS}, r"paths are of type \|S1"),
        (
            {"paths": PATHS.astype(object), "descriptors": ROWS},
            "not a readable .npz archive .ValueError",
        ),
        ({"paths": PATHS, "descriptors": NAN}, "embedding of 'a' is not finite"),
        ({"paths": PATHS, "descriptors": ZERO}, "embedding of 'b' is zero"),
        ({"paths": np.array(["a", "b", "a"]), "descriptors": ROWS}, "'a' occurs twice"),
    ],
)
def test_faults_are_named(tmp_path: Path, arrays: dict[str, np.ndarray], message: str) -> None:
    np.savez(tmp_path / "e.npz", **arrays)
    with pytest.raises(DatasetError, match=message):
        read_embeddings(tmp_path / "e.npz")


def test_a_broken_array_is_refused_and_a_hostile_one_runs_nothing(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.save(stream, PATHS)
    for descriptors in (b"PK", b"", npy("__import__('os').system('true')"), npy(HUGE)):
        with zipfile.ZipFile(tmp_path / "e.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("paths.npy", stream.getvalue())
            archive.writestr("descriptors.npy", descriptors)
        with pytest.raises((DatasetError, MemoryError)):
            read_embeddings(tmp_path / "e.npz")


HUGE = "{'descr': '<f4', 'fortran_order': False, 'shape': (9999999, 99999999)}"


def npy(header: str) -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


NAMES = ["Ann/Ann_0001.jpg", "Ann/Ann_0002.jpg", "Bob/Bob_0001.jpg"]


@pytest.mark.parametrize(
    ("paths", "expected"),
    [
        (NAMES[::-1], [2, 1, 0]),
        (["Bob/Bob_0001", "Ann/Ann_0001.png"], [1, -1, 0]),
        (["/data/lfw/Ann/Ann_0001.jpg", "C:\\faces\\Bob\\Bob_0001.JPG"], [0, -1, 1]),
        (["./Ann_0001.jpg", "crops/Ann_0002.npy.jpg", "other/Bob_0001.jpg"], [0, -1, 2]),
        # The exact name wins over another file with the same end.
        (["old/Ann/Ann_0001.jpg", "Ann/Ann_0001.jpg"], [1, -1, -1]),
        ([], [-1, -1, -1]),
    ],
)
def test_lfw_names(paths: list[str], expected: list[int]) -> None:
    np.testing.assert_array_equal(match(embeddings(paths), benchmark("lfw", NAMES)), expected)


@pytest.mark.parametrize(
    ("kind", "names", "paths", "message"),
    [
        ("lfw", NAMES, ["x/Ann/Ann_0001.jpg", "y/Ann/Ann_0001.jpg"], "Ann_0001.jpg may be 'x/Ann"),
        ("lfw", NAMES, ["Ann/Ann_0001.png", "Ann/Ann_0001.webp"], "Ann_0001.jpg may be"),
        ("pairs", ["a/1.jpg"], ["x/a/1.jpg", "y/a/1.jpg"], "a/1.jpg may be 'x/a/1.jpg' or"),
    ],
)
def test_ambiguous_names(kind: str, names: list[str], paths: list[str], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        match(embeddings(paths), benchmark(kind, names))


def test_a_photo_of_another_person_is_never_taken() -> None:
    cfp = benchmark("cfp", ["Data/Images/001/frontal/01.jpg", "Data/Images/002/frontal/01.jpg"])
    paths = ["/aligned/002/frontal/01.png", "/aligned/003/frontal/01.png"]
    np.testing.assert_array_equal(match(embeddings(paths), cfp), [-1, 0])
    mine = benchmark("pairs", ["ann/1.jpg", "bob/1.jpg"])
    np.testing.assert_array_equal(
        match(embeddings(["/x/bob/1.jpg", "/x/eve/1.jpg"]), mine), [-1, 0]
    )
