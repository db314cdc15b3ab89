"""Descriptors from elsewhere, and their photos."""

import hashlib
import io
import tracemalloc
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.verify.evaluation.layouts import cfp_folder, lfw_folder, write
from verify import DatasetError
from verify.evaluation.embeddings_file import EmbeddingsFile, match, read_embeddings
from verify.evaluation.readers import open_sets
from verify.evaluation.verification_set import PictureBytes, VerificationSet


def rows_of(count: int, n: int = 8) -> np.ndarray:
    return np.random.default_rng(count).normal(size=(count, n))


def embeddings(paths: Sequence[str]) -> EmbeddingsFile:
    return EmbeddingsFile(tuple(paths), np.eye(len(paths), dtype=np.float32), "0" * 64)


def benchmark(kind: str, names: Sequence[str]) -> VerificationSet:
    none = np.zeros(0, dtype=np.int64)
    pictures = tuple(PictureBytes(name, b"") for name in names)
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
    np.testing.assert_allclose(read.descriptors, expected, atol=1e-7)
    assert read.descriptors.dtype == np.float32
    assert read.descriptors.flags.c_contiguous


PATHS = np.array(["a", "b", "c"])
ROWS = np.eye(3, 4)
NAN = np.where(np.eye(3, 4) == 1, np.nan, 1.0)
ZERO = ROWS * np.array([[1], [0], [1]])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"paths": PATHS}, "no array descriptors, only 'paths.npy'"),
        ({"descriptors": ROWS}, "no array paths"),
        ({"paths": PATHS[:2], "descriptors": ROWS}, "expected .N,. and .N, n."),
        ({"paths": PATHS, "descriptors": ROWS[0]}, "expected .N,. and .N, n."),
        ({"paths": PATHS[:0], "descriptors": ROWS[:0]}, "expected .N,.|no readable"),
        ({"paths": PATHS, "descriptors": ROWS.astype(int)}, "descriptors is of type i8"),
        ({"paths": PATHS, "descriptors": ROWS.astype(complex)}, "descriptors is of type c16"),
        ({"paths": PATHS.astype("S"), "descriptors": ROWS}, "paths is of type S1"),
        ({"paths": PATHS.astype(object), "descriptors": ROWS}, "paths is of type O8"),
        ({"paths": PATHS, "descriptors": NAN}, r"3 fault\(s\).*descriptor of 'a' is not finite"),
        ({"paths": PATHS, "descriptors": ZERO}, "descriptor of 'b' is zero"),
        ({"paths": np.array(["a", "b", "a"]), "descriptors": ROWS}, "'a' occurs twice"),
    ],
)
def test_faults_are_named(tmp_path: Path, arrays: dict[str, np.ndarray], message: str) -> None:
    np.savez(tmp_path / "e.npz", **arrays)
    with pytest.raises(DatasetError, match=message):
        read_embeddings(tmp_path / "e.npz")


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


@pytest.mark.parametrize(
    ("descriptors", "message"),
    [
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1, 100000000)}"), "not as long"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (9999999, 99999)}"), "beyond"),
        (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 4)}", bytes(64)), "beyond"),
        (
            npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1, 4)}", bytes(17)),
            "not as long",
        ),
        (npy("__import__('os').system('true')"), "no readable"),
        (b"PK", "no readable"),
        (b"", "no readable"),
    ],
)
def test_hostile_arrays_take_no_memory(tmp_path: Path, descriptors: bytes, message: str) -> None:
    stream = io.BytesIO()
    np.save(stream, PATHS)
    with zipfile.ZipFile(tmp_path / "e.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("paths.npy", stream.getvalue())
        archive.writestr("descriptors.npy", descriptors)
    tracemalloc.start()
    with pytest.raises(DatasetError, match=message):
        read_embeddings(tmp_path / "e.npz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * 2**20


@given(st.binary(max_size=200))
@settings(max_examples=50, deadline=None)
def test_random_files(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    file = write(tmp_path_factory.getbasetemp() / "random.npz", data)
    with pytest.raises(DatasetError):
        read_embeddings(file)


def test_a_cut_archive(tmp_path: Path) -> None:
    np.savez(tmp_path / "e.npz", paths=PATHS, descriptors=ROWS)
    data = (tmp_path / "e.npz").read_bytes()
    for end in range(0, len(data), 31):
        with pytest.raises(DatasetError):
            read_embeddings(write(tmp_path / "cut.npz", data[:end]))
    with pytest.raises(DatasetError, match="cannot be read"):
        read_embeddings(tmp_path / "absent.npz")


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
        # So does the longer common end.
        (["/x/Eve/Ann_0001.jpg", "/x/Ann/Ann_0001.jpg"], [1, -1, -1]),
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
        ("pairs", ["a/1.jpg", "b/1.jpg"], ["1.jpg"], "'1.jpg' fits both a/1.jpg and b/1.jpg"),
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


def test_photos_of_a_bin_by_place() -> None:
    bins = benchmark("bin", ["00000", "00001", "00007"])
    paths = [f"{place:05d}" for place in range(8)]
    positions = match(embeddings(paths), bins)
    np.testing.assert_array_equal(positions, [0, 1, 7])
    assert positions.dtype == np.int64


def test_sets_without_photos(tmp_path: Path) -> None:
    lfw_folder(tmp_path / "lfw", photos=False)
    cfp_folder(tmp_path / "cfp", photos=False)
    for root in ("lfw", "cfp"):
        for one in open_sets(tmp_path / root, pictures=False):
            paths = [f"/elsewhere/{picture.name}" for picture in one.pictures]
            np.testing.assert_array_equal(match(embeddings(paths), one), np.arange(len(paths)))
