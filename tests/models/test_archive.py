"""Archives that strangers made: nothing is written but graphs, inside the folder."""

import random
import stat
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest

from models import archive
from models.archive import unpack
from models.errors import PackError

GRAPH = b"a graph"


def zipped(folder: Path, *entries: tuple[str | zipfile.ZipInfo, bytes]) -> Path:
    path = folder / "pack.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in entries:
            file.writestr(name, data)
    return path


def target(folder: Path) -> Path:
    into = folder / "into"
    into.mkdir()
    return into


def test_graphs_and_the_pack_file_are_taken_flat(tmp_path: Path) -> None:
    path = zipped(
        tmp_path,
        ("buffalo/", b""),
        ("buffalo/det.onnx", GRAPH),
        ("buffalo/rec.ONNX", GRAPH),
        ("buffalo/pack.toml", b"[embedder]"),
        ("buffalo/README.md", b"hello"),
        ("__MACOSX/buffalo/._det.onnx", b"leftover"),
        ("run.py", b"import os"),
    )
    into = target(tmp_path)
    assert unpack(path, into) == 3
    assert sorted(file.name for file in into.iterdir()) == ["det.onnx", "pack.toml", "rec.ONNX"]
    assert (into / "det.onnx").read_bytes() == GRAPH


@pytest.mark.parametrize(
    "entry", ["../det.onnx", "a/../../det.onnx", "/etc/det.onnx", "..\\det.onnx", "C:\\det.onnx"]
)
def test_a_path_that_leads_out_of_the_archive_does_not(tmp_path: Path, entry: str) -> None:
    into = target(tmp_path)
    unpack(zipped(tmp_path, (entry, GRAPH)), into)
    assert list(into.iterdir()) == [into / "det.onnx"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["into", "pack.zip"]


def test_a_link_is_written_as_a_file(tmp_path: Path) -> None:
    entry = zipfile.ZipInfo("det.onnx")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    into = target(tmp_path)
    unpack(zipped(tmp_path, (entry, b"/etc/passwd")), into)
    assert not (into / "det.onnx").is_symlink()
    assert (into / "det.onnx").read_bytes() == b"/etc/passwd"


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        ("a\u202exnno.exe.onnx", r"cannot be printed: 'a\\u202exnno"),
        ("det.txt", "no .onnx file"),
    ],
)
def test_a_pack_needs_a_graph_with_a_name_that_can_be_shown(
    tmp_path: Path, entry: str, reason: str
) -> None:
    with pytest.raises(PackError, match=reason):
        unpack(zipped(tmp_path, (entry, GRAPH)), target(tmp_path))
    assert not list((tmp_path / "into").iterdir())


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (["a/det.onnx", "b/det.onnx"], "two files of the same name"),
        ([f"{number}.onnx" for number in range(101)], "more than 100 entries"),
    ],
)
def test_two_graphs_of_one_name_or_too_many_are_refused(
    tmp_path: Path, names: list[str], reason: str
) -> None:
    path = zipped(tmp_path, *((name, GRAPH) for name in names))
    with pytest.raises(PackError, match=reason):
        unpack(path, target(tmp_path))


def test_an_archive_that_swells_is_stopped_while_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive, "MAX_FILE_BYTES", 5_000)
    into = target(tmp_path)
    path = zipped(tmp_path, ("det.onnx", bytes(10_000)))
    # The directory states fewer bytes than there are.
    data = bytearray(path.read_bytes())
    for position in (22, data.index(b"PK\x01\x02") + 24):
        assert int.from_bytes(data[position : position + 4], "little") == 10_000
    with pytest.raises(PackError, match="too large"):
        unpack(path, into)
    assert (into / "det.onnx").stat().st_size <= 5_000

    monkeypatch.setattr(archive, "MAX_FILE_BYTES", 20_000)
    monkeypatch.setattr(archive, "MAX_TOTAL_BYTES", 15_000)
    path = zipped(tmp_path, ("one.onnx", bytes(10_000)), ("two.onnx", bytes(10_000)))
    with pytest.raises(PackError, match="too large"):
        unpack(path, into)


def test_broken_and_encrypted_archives_are_refused(tmp_path: Path) -> None:
    path = zipped(tmp_path, ("det.onnx", GRAPH * 100))
    whole = path.read_bytes()
    flagged = bytearray(whole)
    for position in (6, flagged.index(b"PK\x01\x02") + 8):
        flagged[position] |= 1
    broken = bytearray(whole)
    broken[45] ^= 0xFF
    for number, data in enumerate((bytes(flagged), bytes(broken), whole[:-30], b"", b"PK" * 50)):
        path.write_bytes(data)
        into = tmp_path / f"into-{number}"
        into.mkdir()
        with pytest.raises(PackError, match="damaged or encrypted"):
            unpack(path, into)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_what_is_neither_stored_nor_deflated_is_refused(tmp_path: Path, method: int) -> None:
    path = tmp_path / "pack.zip"
    with zipfile.ZipFile(path, "w", method) as file:
        file.writestr("det.onnx", GRAPH)
    with pytest.raises(PackError, match=r"neither stored nor deflated.*det\.onnx"):
        unpack(path, target(tmp_path))


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_no_damage_writes_outside_or_fails_otherwise(tmp_path: Path, method: int) -> None:
    drawn = random.Random(0)
    path, into = tmp_path / "pack.zip", target(tmp_path)
    with zipfile.ZipFile(path, "w", method) as file:
        file.writestr("a/det.onnx", drawn.randbytes(50) * 10)
        file.writestr("a/\N{GREEK SMALL LETTER ALPHA}.onnx", GRAPH)
    whole = path.read_bytes()
    for _ in range(100):
        data = bytearray(whole)
        for _ in range(drawn.randint(1, 4)):
            data[drawn.randrange(len(data))] = drawn.randrange(256)
        path.write_bytes(data)
        with suppress(PackError):
            unpack(path, into)
        assert sorted(entry.name for entry in tmp_path.iterdir()) == ["into", "pack.zip"]
        for written in into.iterdir():
            written.unlink()
