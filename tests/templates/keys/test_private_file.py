"""Files that are written in one piece, and not over what another user owns."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from templates.keys.private_file import (
    create_private,
    read_at_most,
    replace_private,
    replace_public,
)

STRANGER = 61234
WRITERS = (replace_private, replace_public)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
@pytest.mark.parametrize("write", [*WRITERS, create_private])
@pytest.mark.parametrize("theirs", ["file", "folder"])
def test_root_writes_over_nothing_of_another_user(
    tmp_path: Path, write: Callable[[Path, bytes], None], theirs: str
) -> None:
    path = tmp_path / "data" / "out"
    path.parent.mkdir()
    if theirs == "file":
        path.write_bytes(b"before")
    os.chown(path if theirs == "file" else path.parent, STRANGER, STRANGER)
    with pytest.raises(PermissionError, match=f"belongs to user {STRANGER}: run this") as refused:
        write(path, b"after")
    assert refused.value.filename == str(path)
    assert [each.read_bytes() for each in path.parent.iterdir()] in ([], [b"before"])


@pytest.mark.parametrize("write", WRITERS)
def test_own_links_are_followed_and_stay(
    tmp_path: Path, write: Callable[[Path, bytes], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "real" / "deep").mkdir(parents=True)
    (tmp_path / "folder").symlink_to(tmp_path / "real")
    (tmp_path / "real" / "link").symlink_to("deep/../deep/out")
    monkeypatch.chdir(tmp_path / "real")
    for number, path in enumerate((tmp_path / "folder" / "link", Path("../folder/./link"))):
        write(path, b"%d" % number)
        assert (tmp_path / "real" / "deep" / "out").read_bytes() == b"%d" % number
    assert (tmp_path / "real" / "link").is_symlink()
    assert [path.name for path in (tmp_path / "real" / "deep").iterdir()] == ["out"]


def test_modes_and_missing_folders(tmp_path: Path) -> None:
    def mode(path: Path) -> int:
        return stat.S_IMODE(path.stat().st_mode)

    before = os.umask(0o022)
    try:
        replace_private(tmp_path / "a" / "b" / "private", b"1")
        replace_public(tmp_path / "a" / "b" / "public", b"2")
        create_private(tmp_path / "keys" / "key", b"3")
    finally:
        os.umask(before)
    assert mode(tmp_path / "a" / "b" / "private") == mode(tmp_path / "keys" / "key") == 0o600
    assert mode(tmp_path / "a" / "b" / "public") == 0o644
    assert (mode(tmp_path / "a"), mode(tmp_path / "keys")) == (0o755, 0o700)
    assert [path.name for path in (tmp_path / "keys").iterdir()] == ["key"]


def test_a_new_file_replaces_nothing(tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(b"before")
    (tmp_path / "link").symlink_to("absent")
    for name in ("key", "link"):
        with pytest.raises(FileExistsError):
            create_private(tmp_path / name, b"after")
    assert (tmp_path / "key").read_bytes() == b"before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["key", "link"]


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, tmp_path / "..", Path()):
        with pytest.raises(OSError, match="no regular file"):
            replace_private(path, b"template")
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_a_write_that_fails_leaves_the_old_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out"
    path.write_bytes(b"before")
    for call in ("fsync", "replace"):
        with monkeypatch.context() as patched:

            def fail(*_: object, **__: object) -> None:
                raise OSError(28, "No space left on device")

            patched.setattr(*((os, call) if call == "fsync" else (Path, call)), fail)
            with pytest.raises(OSError, match="No space left") as failed:
                replace_private(path, b"after")
        assert failed.value.filename == str(path)
        assert [each.name for each in tmp_path.iterdir()] == ["out"]
        assert path.read_bytes() == b"before"


@pytest.mark.parametrize(("size", "most"), [(10, 10), (11, 10), (5 * 2**20, 2**20), (5, 0)])
def test_one_byte_more_than_the_limit_tells_of_a_larger_file(
    tmp_path: Path, size: int, most: int
) -> None:
    content = os.urandom(size)
    (tmp_path / "file").write_bytes(content)
    with (tmp_path / "file").open("rb") as file:
        assert read_at_most(file, most) == content[: most + 1]


@pytest.mark.parametrize("most", [2**30, 4_000, 1_000])
def test_a_pipe_which_has_no_size_is_read_as_well(most: int) -> None:
    content = os.urandom(4_000)  # fits into the smallest pipe
    reading, writing = os.pipe()
    os.write(writing, content)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        assert read_at_most(file, most) == content[: most + 1]
