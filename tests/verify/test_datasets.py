from pathlib import Path

import pytest

from verify import DatasetError, labelled_folder
from verify.datasets import distinct_files


def make_folder(root: Path, photos: dict[str, int]) -> Path:
    for name, count in photos.items():
        (root / name).mkdir(parents=True)
        for i in range(1, count + 1):
            (root / name / f"{name}_{i:04d}.jpg").write_bytes(b"not opened here")
    return root


def test_people_and_photos_are_listed_in_order(tmp_path: Path) -> None:
    root = make_folder(tmp_path, {"Bob": 2, "Ann": 1})
    (root / "pairs.txt").write_text("x")
    (root / ".DS_Store").write_text("x")
    (root / "Ann" / "notes.txt").write_text("x")
    folder = labelled_folder(root)
    assert folder.identities == ("Ann", "Bob", "Bob")
    assert [path.name for path in folder.paths] == ["Ann_0001.jpg", "Bob_0001.jpg", "Bob_0002.jpg"]
    assert folder.ignored == ("Ann/notes.txt", "pairs.txt")
    assert (len(folder), folder.people) == (3, 2)
    assert folder.without({"Bob", "Eve"}).identities == ("Ann",)
    kept = folder.without({"Ann", "Bob/Bob_0001.jpg"})
    assert [path.name for path in kept.paths] == ["Bob_0002.jpg"]
    assert kept.excluded == 2


def test_what_is_no_photo_of_a_person_is_left_out_and_named(tmp_path: Path) -> None:
    root = make_folder(tmp_path, {"Bob": 1, "Nobody": 0})
    for name in (
        "stray.png",
        "Bob/Bob.heic",
        "Bob/more/old.jpg",
        "Bob/scan.jfif",
        "Bob/@eaDir/Bob.jpg/thumb.jpg",
        "@eaDir/Bob/thumb.jpg",
        "__MACOSX/Bob/._Bob.jpg",
    ):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"")
    folder = labelled_folder(root)
    assert [path.name for path in folder.paths] == ["Bob_0001.jpg", "scan.jfif"]
    assert folder.ignored == ("Bob/Bob.heic", "Bob/more", "Nobody (empty)", "stray.png")


def test_the_folder_of_the_people_is_named_where_another_one_is_around_it(tmp_path: Path) -> None:
    make_folder(tmp_path / "lfw" / "lfw", {"Ann": 1, "Bob": 2})
    with pytest.raises(DatasetError, match=rf": give {tmp_path / 'lfw' / 'lfw'}$"):
        labelled_folder(tmp_path / "lfw")


def test_of_copies_the_first_is_kept(tmp_path: Path) -> None:
    contents = {"a": b"one", "b": b"two", "c": b"one", "d": b"longer", "e": b"two"}
    files = [tmp_path / name for name in contents]
    for file in files:
        file.write_bytes(contents[file.name])
    assert [file.name for file in distinct_files(files)] == ["a", "b", "d"]


@pytest.mark.parametrize("kind", ["absent", "file", "empty"])
def test_what_is_no_labelled_folder_is_refused(tmp_path: Path, kind: str) -> None:
    root = tmp_path / "root"
    if kind == "file":
        root.write_text("x")
    if kind == "empty":
        root.mkdir()
    with pytest.raises(DatasetError, match="root/Person/photo"):
        labelled_folder(root)
