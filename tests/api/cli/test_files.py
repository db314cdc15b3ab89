import pytest

from api.cli.errors import CommandError
from api.cli.files import find_photos, is_left_out, read_bounded, read_names


def test_photos_are_found_at_any_depth_in_order(tmp_path):
    for name in ("b/2.JPG", "a/deep/1.png", "a/notes.txt", "c.webp"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    found = [path.relative_to(tmp_path).as_posix() for path in find_photos(tmp_path)]
    assert found == ["a/deep/1.png", "b/2.JPG", "c.webp"]


def test_a_folder_without_photos_is_refused(tmp_path):
    with pytest.raises(CommandError, match=r"has no \.jpg"):
        find_photos(tmp_path)
    with pytest.raises(CommandError, match="is not a folder"):
        find_photos(tmp_path / "absent")


def test_names_come_from_a_folder_or_a_file(tmp_path):
    folder = tmp_path / "people"
    (folder / "Ann").mkdir(parents=True)
    (folder / "readme.txt").write_text("x")
    assert read_names(folder) == {"Ann"}
    listing = tmp_path / "names.txt"
    listing.write_text("# people of the test\nBob\n\n train/9.jpg \n")
    assert read_names(listing) == {"Bob", "train/9.jpg"}


def test_a_person_or_a_photo_is_left_out(tmp_path):
    photo = tmp_path / "Bob" / "1.jpg"
    assert is_left_out(photo, tmp_path, frozenset({"Bob"}))
    assert is_left_out(photo, tmp_path, frozenset({"Bob/1.jpg"}))
    assert not is_left_out(photo, tmp_path, frozenset({"Bo", "1.jpg"}))


def test_a_large_file_is_refused(tmp_path):
    path = tmp_path / "template"
    path.write_bytes(b"123456")
    assert read_bounded(path, 6) == b"123456"
    with pytest.raises(CommandError, match="more than 5 bytes"):
        read_bounded(path, 5)
