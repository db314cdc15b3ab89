"""Folders and CSV files of live and attack photos."""

from pathlib import Path

import pytest

from verify.datasets import DatasetError
from verify.evaluation.liveness.presentations import read_presentations


def write(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"photo")
    return root


def test_a_folder_of_live_and_spoof(tmp_path):
    root = write(
        tmp_path / "booth",
        *("live/b.jpg", "live/deep/a.PNG", "live/.hidden.jpg", "live/notes.txt"),
        *("spoof/print/x.jpg", "spoof/mask v2/y.webp", "readme.md"),
    )
    presented = read_presentations(root, attacks=True)
    assert presented.name == "booth"
    assert [(one.name, one.species) for one in presented.presentations] == [
        ("live/b.jpg", None),
        ("live/deep/a.PNG", None),
        ("spoof/mask v2/y.webp", "mask v2"),
        ("spoof/print/x.jpg", "print"),
    ]
    assert presented.species == ("mask v2", "print")
    assert presented.subjects is None


def test_the_number_that_every_name_begins_with_is_the_subject(tmp_path):
    root = write(tmp_path, "live/0001_00_1.jpg", "live/0002_7.jpg", "spoof/print/0001_9.jpg")
    presented = read_presentations(root, attacks=True)
    assert [one.subject for one in presented.presentations] == ["0001", "0002", "0001"]
    assert presented.subjects == 2
    write(root, "spoof/print/other.jpg")
    presented = read_presentations(root, attacks=True)
    assert {one.subject for one in presented.presentations} == {None}


def test_a_csv(tmp_path):
    write(tmp_path, "a.jpg", "b.jpg", "c.jpg")
    table = tmp_path / "booth.csv"
    table.write_text("Path,presentation,subject\nc.jpg,replay,ann\na.jpg,live,ann\n\nb.jpg,live,\n")
    presented = read_presentations(table, attacks=True)
    assert (presented.name, presented.subjects) == ("booth", None)
    assert [(one.path, one.species, one.subject) for one in presented.presentations] == [
        (tmp_path / "a.jpg", None, "ann"),
        (tmp_path / "b.jpg", None, None),
        (tmp_path / "c.jpg", "replay", "ann"),
    ]


def test_attacks_are_asked_for_where_they_are_needed(tmp_path):
    write(tmp_path, "live/a.jpg")
    assert len(read_presentations(tmp_path, attacks=False).presentations) == 1
    with pytest.raises(DatasetError, match="no attack photo"):
        read_presentations(tmp_path, attacks=True)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([], "live holds no photo"),
        (["spoof/print/a.jpg"], "live holds no photo"),
        (["live/readme.txt", "spoof/print/a.jpg"], "live holds no photo"),
        (["live/a.jpg", "spoof/a.jpg"], "spoof/'a.jpg' is no name of a species"),
        (["live/a.jpg", "spoof/print/a.txt"], "spoof/print holds no photo"),
        (["live/a.jpg", "spoof/live/a.jpg"], "'live' is no name of a species"),
        (["live/a.jpg", "spoof/p|q/a.jpg"], "is no name of a species"),
        (["live/a.jpg", "attack/print/a.jpg"], "attack lies beside"),
        (["live/a.jpg", "b.jpg"], "b.jpg lies beside"),
    ],
)
def test_faults_of_a_folder_are_named(tmp_path, names, said):
    tmp_path.mkdir(exist_ok=True)
    write(tmp_path, *names)
    with pytest.raises(DatasetError, match=said):
        read_presentations(tmp_path, attacks=True)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("path,label\n", "has no column presentation"),
        ("path,path,presentation\n", "names a column twice"),
        ("path,presentation\na.jpg\n", "line 2 has 1 cells, not 2"),
        ("path,presentation\n,live\n", "line 2 has no path"),
        ("path,presentation\nz.jpg,live\n", "line 2 names z.jpg, which is not there"),
        ("path,presentation\na.jpg,\n", "line 2 has neither live nor a species"),
        ("path,presentation\na.jpg,live\na.jpg,print\n", "a.jpg is named twice"),
        ('path,presentation\n"a.jpg,live\n', "is not CSV"),
        ("path,presentation\n", "no live photo"),
    ],
)
def test_faults_of_a_csv_are_named(tmp_path, text, said):
    write(tmp_path, "a.jpg")
    table = tmp_path / "booth.csv"
    table.write_text(text)
    with pytest.raises(DatasetError, match=said):
        read_presentations(table, attacks=True)


def test_nothing_there(tmp_path):
    with pytest.raises(DatasetError, match=r"is not there; expected live/.*path,presentation"):
        read_presentations(tmp_path / "nowhere", attacks=True)
