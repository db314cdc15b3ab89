import pytest

from verify.datasets import DatasetError
from verify.fairface_labels import AGES, label_files, read_labels, repaired_age

HEADER = "file,age,gender,race,service_test\n"


@pytest.mark.parametrize(
    ("cell", "age"),
    [
        *((age, age) for age in AGES),
        ("03-Sep", "3-9"),
        ("3-Sep", "3-9"),
        ("9-Mar", "3-9"),
        ("19-Oct", "10-19"),
        ("Oct-19", "10-19"),
        (" 20-29 ", "20-29"),
        ("20-30", None),
        ("12-Dec", None),
        ("", None),
    ],
)
def test_ages_that_a_spreadsheet_made_dates_of_are_repaired(cell, age):
    assert repaired_age(cell) == age


def test_labels_are_found_by_the_path_of_the_photo(tmp_path):
    file = tmp_path / "fairface_label_train.csv"
    file.write_text(HEADER + "train/1.jpg,Oct-19,Female,East Asian,FALSE\n", encoding="utf-8-sig")
    labels = read_labels(file)
    label = labels[(tmp_path / "train" / "1.jpg").resolve()]
    assert label == {"age": "10-19", "gender": "Female", "race": "East Asian"}
    (tmp_path / "train").mkdir()
    assert label_files(tmp_path / "train") == [file.resolve()]
    assert label_files(tmp_path) == [file]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("train/1.jpg,99,Female,Black,FALSE", "line 2: the age is none of"),
        ("train/1.jpg,3-9,female,Black,FALSE", "line 2: the gender is none of Male, Female"),
        ("train/1.jpg,3-9,Female,Martian,FALSE", "line 2: the race is none of"),
        ("train/1.jpg,3-9,,Black,FALSE", "line 2: the gender is none of"),
        ("train/1.jpg", "line 2 has 1 cells, not 5"),
        (
            "train/\0.jpg,3-9,Female,Black,FALSE",
            "line 2: the name of the file is empty or not printable",
        ),
        (",3-9,Female,Black,FALSE", "line 2: the name of the file is empty"),
        ("train/\u202e.jpg,3-9,Female,Black,FALSE", "line 2: the name of the file"),
    ],
)
def test_a_wrong_line_is_named(tmp_path, line, said):
    file = tmp_path / "labels.csv"
    file.write_text(HEADER + line + "\n")
    with pytest.raises(DatasetError, match=said):
        read_labels(file)
