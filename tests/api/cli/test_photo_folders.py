"""Folders of photos: what is read of them, and what the person is told of the rest."""

from pathlib import Path

import pytest

from api.cli.errors import CommandError
from api.cli.files import read_names
from api.cli.photo_folders import find_photos, labelled_people, photos_of


def fill(folder: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def test_photos_are_found_at_any_depth_in_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {"b/2.JPG": b"2", "a/deep/1.png": b"1", "a/notes.txt": b"", "c.webp": b"c"}
    fill(tmp_path, files | {"a/5.heic": b"5", "d.jpg": b"2", "@eaDir/1.jpg": b"1", ".t/1.jpg": b""})
    found = [path.relative_to(tmp_path).as_posix() for path in find_photos(tmp_path)]
    assert found == ["a/deep/1.png", "b/2.JPG", "c.webp"]
    told = capsys.readouterr().err
    assert f"not read in {tmp_path}: 2 files, as a/5.heic\n" in told
    assert f"copies of another photo in {tmp_path} do not count: 1" in told


def test_a_folder_without_photos_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match=r"has no file in \.bmp, .*\.webp"):
        find_photos(tmp_path)
    with pytest.raises(CommandError, match="is not a folder"):
        find_photos(tmp_path / "absent")


def test_copies_of_one_persons_photo_count_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of another person they stay, so that the calibration finds the two people alike."""
    photos = {f"Ann/{i}.jpg": b"ann" for i in range(5)} | {"Bob/1.jpg": b"ann", "Bob/2.jpg": b"bob"}
    labelled = labelled_people(fill(tmp_path, photos | {"Bob/3.tif": b""}))
    assert labelled.identities == ("Ann", "Bob", "Bob")
    told = capsys.readouterr().err
    assert "do not count: 4" in told
    assert "1 files, as Bob/3.tif" in told


def test_people_and_photos_are_left_out_by_a_list_or_a_folder(tmp_path: Path) -> None:
    files = {f"Bob/{i}.jpg": bytes([i]) for i in range(2)} | {"Ann/9.jpg": b"9", "Cid/9.jpg": b"0"}
    fill(tmp_path / "faces", files)
    listing = tmp_path / "names.txt"
    listing.write_text("# people of the test\nBob\n\n Ann/9.jpg \n9.jpg\nCi\n")
    assert read_names(listing) == {"Bob", "Ann/9.jpg", "9.jpg", "Ci"}
    (photo,), left_out = photos_of([tmp_path / "faces"], read_names(listing))
    assert (photo.parent.name, left_out) == ("Cid", 3)
    (tmp_path / "people" / "Bob").mkdir(parents=True)
    labelled = labelled_people(tmp_path / "faces").without(read_names(tmp_path / "people"))
    assert labelled.identities == ("Ann", "Cid")
    assert read_names(None) == frozenset()
