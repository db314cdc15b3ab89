"""Files of strangers are read in a process of their own."""

import contextlib
import os
import resource
import struct
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from tests.verify.evaluation.layouts import agedb_folder
from verify.datasets import DatasetError
from verify.evaluation.embeddings_file import read_embeddings
from verify.evaluation.readers import open_sets
from verify.evaluation.readers import reader as module
from verify.evaluation.readers.agedb import PROTOCOL
from verify.evaluation.readers.reader import isolated

LONG = pytest.mark.long
NAMED = b"c_codecs\nencode\nq\x000X"
BOMBS = {
    "memo position": b"K\x01r\xff\xff\xff\xff.",
    "bytes beyond the file": b"\x80\x04\x8e" + struct.pack("<Q", 2**40) + b".",
    "bytearray beyond the file": b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b".",
    "encoding one string again and again": (
        NAMED
        + struct.pack("<I", 2**20)
        + b"a" * 2**20
        + b"q\x01Vlatin1\nq\x02("
        + b"h\x00h\x01h\x02\x86R" * 100_000
        + b"l."
    ),
    "deep nesting": b"N" + b"\x85" * 300_000 + b".",
}


def process_of(file: Path) -> int:
    return os.getpid()


def crash(file: Path) -> None:
    os._exit(1)


def test_a_reader_runs_elsewhere_and_its_end_is_said(tmp_path: Path) -> None:
    assert isolated(process_of, tmp_path) != os.getpid()
    with pytest.raises(DatasetError, match="is not readable: its reader crashed"):
        isolated(crash, tmp_path)


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_takes_no_memory_here(name: str, tmp_path: Path) -> None:
    file = tmp_path / "bomb.bin"
    file.write_bytes(BOMBS[name])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MEMORY_BYTES", 2**28)
        with pytest.raises(DatasetError):
            open_sets(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 32 * 1024


def test_a_matlab_file_that_unpacks_to_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MEMORY_BYTES", 2**28)
    agedb_folder(tmp_path)
    scipy.io.savemat(tmp_path / PROTOCOL, {"splits": np.zeros(2**26)}, do_compression=True)
    with pytest.raises(DatasetError, match="256 MiB"):
        open_sets(tmp_path)


def test_an_archive_that_unpacks_to_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MEMORY_BYTES", 2**28)
    file = tmp_path / "e.npz"
    np.savez_compressed(file, paths=np.array(["a"]), descriptors=np.zeros((1, 2**27), "f4"))
    with pytest.raises(DatasetError, match="256 MiB"):
        read_embeddings(file)
    rows = np.eye(2, 4)
    np.savez(file, paths=np.array(["a", "b"]), descriptors=2 * rows)
    np.testing.assert_array_equal(read_embeddings(file).embeddings, rows)


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(k, marks=LONG) for k in range(4, 40))])
def test_an_altered_matlab_file_only_ever_raises_one_exception(seed: int, tmp_path: Path) -> None:
    """SciPy's reader ends its process on some of them."""
    generator = np.random.default_rng(seed)
    file = agedb_folder(tmp_path, compressed=False, photos=False) / PROTOCOL
    raw = bytearray(file.read_bytes())
    for place in generator.integers(128, 1500, size=4):
        raw[place] = generator.choice([*range(20), 127, 255])
    file.write_bytes(raw)
    with contextlib.suppress(DatasetError):
        open_sets(tmp_path, pictures=False)
