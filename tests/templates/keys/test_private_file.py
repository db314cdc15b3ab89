"""Files that root writes where the service's user, or a stranger, may have put a link."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from templates.keys.private_file import (
    create_private,
    make_folder,
    replace_private,
    replace_public,
)

SERVICE = 61234
WRITERS = (replace_private, replace_public)
Plant = Callable[[Path, Path], None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of the service's user, where the tests run as root."""
    path = tmp_path / "data"
    path.mkdir()
    if os.geteuid() == 0:
        os.chown(path, SERVICE, SERVICE)
    return path


@pytest.fixture
def plant(monkeypatch: pytest.MonkeyPatch) -> Plant:
    """Make a link as somebody else: the service's user, or else as seen by another user."""

    def make(link: Path, target: Path) -> None:
        link.symlink_to(target)
        if os.geteuid() == 0:
            os.lchown(link, SERVICE, SERVICE)
        else:
            monkeypatch.setattr(os, "geteuid", lambda: SERVICE)

    return make


@pytest.mark.parametrize("write", WRITERS)
def test_a_planted_link_is_refused_and_its_target_untouched(
    tmp_path: Path, folder: Path, plant: Plant, write: Callable[[Path, bytes], None]
) -> None:
    target = tmp_path / "passwd"
    target.write_bytes(b"before")
    plant(folder / "out", target)
    with pytest.raises(PermissionError, match=r"a link of user .* on the way.*name another") as no:
        write(folder / "out", b"template")
    assert no.value.filename == str(folder / "out")
    assert target.read_bytes() == b"before"
    assert [path.name for path in folder.iterdir()] == ["out"]


@pytest.mark.parametrize("write", [*WRITERS, create_private])
def test_a_planted_link_to_a_folder_is_refused(
    tmp_path: Path, folder: Path, plant: Plant, write: Callable[[Path, bytes], None]
) -> None:
    elsewhere = tmp_path / "etc"
    elsewhere.mkdir()
    plant(folder / "results", elsewhere)
    for path in (folder / "results" / "out", folder / "results" / "deeper" / "out"):
        with pytest.raises(PermissionError, match="a link of user"):
            write(path, b"template")
    with pytest.raises(PermissionError, match="a link of user"):
        make_folder(folder / "results" / "new")
    assert not list(elsewhere.iterdir())


def test_a_link_that_leads_to_a_planted_one_is_refused(
    tmp_path: Path, folder: Path, plant: Plant
) -> None:
    (tmp_path / "own").symlink_to("data/out")
    plant(folder / "out", tmp_path / "passwd")
    with pytest.raises(PermissionError, match="a link of user"):
        replace_private(tmp_path / "own", b"template")
    assert not (tmp_path / "passwd").exists()


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


def test_links_in_a_circle_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OSError, match="no regular file"):
        replace_private(tmp_path / "a", b"template")
    with pytest.raises(OSError, match="symbolic links"):
        replace_private(tmp_path / "a" / "out", b"template")


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

            patched.setattr(os, call, fail)
            with pytest.raises(OSError, match="No space left") as failed:
                replace_private(path, b"after")
        assert failed.value.filename == str(path)
        assert [each.name for each in tmp_path.iterdir()] == ["out"]
        assert path.read_bytes() == b"before"
