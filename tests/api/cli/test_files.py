import pytest

from api.cli.errors import CommandError
from api.cli.files import is_left_out, read_bounded, read_names


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
