from api.cli.files import is_left_out, read_names


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
