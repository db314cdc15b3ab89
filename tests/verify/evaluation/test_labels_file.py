"""Label files: what they say about a picture, and what is wrong with a broken one."""

import pytest

from verify.datasets import DatasetError
from verify.evaluation.labels_file import read_labels
from verify.fairface_labels import AGES, GENDERS, RACES


def written(folder, text, *, encoding="utf-8"):
    file = folder / "labels.csv"
    file.write_text(text, encoding=encoding)
    return file


def test_photos_are_found_by_path_stem_and_person(tmp_path):
    labels = read_labels(
        written(
            tmp_path,
            "path,gender,race\n"
            "Ann_Lee,Female,Indian\n"
            "Ann_Lee/Ann_Lee_0002.jpg,Female,White\n"
            "./Bo/1.png,Male,\n"
            "Bo\\2,Male,Black\n"
            "J._R._Smith,Male,White\n"
            "lone,Male,Indian\n",
            encoding="utf-8-sig",
        )
    )
    assert labels.attributes == ("gender", "race")
    assert labels.find("Ann_Lee/Ann_Lee_0001.jpg") == {"gender": "Female", "race": "Indian"}
    assert labels.find("Ann_Lee/Ann_Lee_0002.jpg")["race"] == "White"
    assert labels.find("Ann_Lee/Ann_Lee_0002.webp")["race"] == "White"
    assert labels.find("set/Ann_Lee/x.jpg")["race"] == "Indian"
    assert labels.find("Bo/1.png") == {"gender": "Male"}
    assert labels.find("Bo/1.jpg") == {"gender": "Male"}
    assert labels.find("Bo/2.jpg")["race"] == "Black"
    assert labels.find("J._R._Smith/1.jpg")["race"] == "White"
    assert labels.find("lone.jpg")["race"] == "Indian"
    for stranger in ("Bo/3.jpg", "Ann/1.jpg", "Ann_Lee_0001.jpg", "J/1.jpg", "17", ""):
        assert labels.find(stranger) == {}
    pictures = ["Bo/1.png", "Bo/2.jpg", "nobody/1.jpg"]
    assert labels.column("race", pictures) == [None, "Black", None]
    assert labels.column("age", pictures) == [None, None, None]


@pytest.mark.parametrize(
    ("cell", "age"),
    [("03-Sep", "3-9"), ("Oct-19", "10-19"), ("20-29", "20-29"), ("adult", "adult")],
)
def test_ages_are_repaired(tmp_path, cell, age):
    labels = read_labels(written(tmp_path, f"file,Age,service_test\na.jpg,{cell},TRUE\n"))
    assert labels.attributes == ("age",)
    assert labels.find("a.jpg") == {"age": age}


@pytest.mark.parametrize(
    ("years", "group"),
    [("0", "0-1"), ("1", "0-1"), ("2", "2-4"), ("10", "8-10"), ("29", "18-29"),
     ("30", "30-44"), ("59", "45-59"), ("60", "60 and more"), ("116", "60 and more")],
)  # fmt: skip
def test_ages_in_years_are_put_into_groups(tmp_path, years, group):
    labels = read_labels(written(tmp_path, f"path,age\na,{years}\n"))
    assert labels.find("a") == {"age": group}


def test_cells_may_hold_commas_and_rows_may_repeat(tmp_path):
    labels = read_labels(
        written(tmp_path, 'path,race\n"Lee, Ann",Black\n\n"Lee, Ann",Black\n , \nO\u2028N,White\n')
    )
    assert labels.find("Lee, Ann/1.jpg") == {"race": "Black"}
    assert labels.find("O\u2028N/1.jpg") == {"race": "White"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no row below the header"),
        ("path,gender\n", "no row below the header"),
        ("name,gender\na,Male\n", "the first column is path or file"),
        ("path\na\n", "one attribute at least"),
        ("path,service_test\na,TRUE\n", "one attribute at least"),
        ("path,gender,\na,Male,\n", "names a column twice, or not at all"),
        ("path,gender,Gender\na,Male,Male\n", "names a column twice"),
        ("path,gender\na,Male,White\n", "line 2 has 3 cells, not 2"),
        ("path,gender\n,Male\n", "line 2 has no path"),
        ("path,gender\na,Male\n\na,Female\n", "line 4 labels a otherwise"),
        ('path,gender\n"a,Male\n', "is not CSV"),
    ],
)
def test_faults_are_named(tmp_path, text, said):
    with pytest.raises(DatasetError, match=said):
        read_labels(written(tmp_path, text))


def test_a_column_of_names_is_no_attribute(tmp_path):
    rows = "".join(f"{i},{i},Male\n" for i in range(257))
    said = r"the column name has more than 256 different labels"
    with pytest.raises(DatasetError, match=said):
        read_labels(written(tmp_path, "path,name,gender\n" + rows))
    kept = "".join(f"{i},{i % 256},Male\n" for i in range(257))
    assert len(read_labels(written(tmp_path, "path,name,gender\n" + kept)).of) == 257


def test_fairface_files_are_read_as_they_are(fairface):
    for part, count in (("train", 5000), ("val", 1500)):
        labels = read_labels(fairface / f"fairface_label_{part}.csv")
        assert labels.attributes == ("age", "gender", "race")
        pictures = [f"{part}/{path.name}" for path in (fairface / part).iterdir()]
        assert len(pictures) == count
        assert set(labels.column("age", pictures)) == set(AGES)
        assert set(labels.column("gender", pictures)) == set(GENDERS)
        assert set(labels.column("race", pictures)) == set(RACES)
