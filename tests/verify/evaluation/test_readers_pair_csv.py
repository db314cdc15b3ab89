"""A user's own pairs as CSV."""

from pathlib import Path

import numpy as np
import pytest

from tests.verify.evaluation.layouts import drawn, write
from verify import DatasetError
from verify.evaluation.readers import open_sets
from verify.evaluation.verification_set import VerificationSet
from verify.tenfold import FOLDS


def read(root: Path, text: str, *, pictures: bool = True) -> VerificationSet:
    for number, name in enumerate(("a1", "a2", "b1")):
        write(root / "photos" / f"{name}.png", drawn(number))
    (benchmark,) = open_sets(write(root / "Mine.csv", text), pictures=pictures)
    return benchmark


def table(header: str, same: str, other: str, *, folds: list[str] | None = None) -> str:
    rows = []
    for fold in folds if folds is not None else [""] * FOLDS:
        rows += [f"{same}{fold}", f"{other}{fold}"]
    return "\n".join([header, *rows]) + "\n"


HEADER = "path_a,path_b,same"
SAME = "photos/a1.png,photos/a2.png,1"
OTHER = "photos/a1.png,photos/b1.png,0"


def test_pairs(tmp_path: Path) -> None:
    mine = read(tmp_path, table(HEADER, SAME, OTHER))
    assert (mine.name, mine.kind, mine.people) == ("Mine", "pairs", None)
    assert [one.name for one in mine.pictures] == [
        "photos/a1.png",
        "photos/a2.png",
        "photos/b1.png",
    ]
    assert [one.read() for one in mine.pictures] == [drawn(0), drawn(1), drawn(2)]
    np.testing.assert_array_equal(mine.first, 0)
    np.testing.assert_array_equal(mine.second, [1, 2] * FOLDS)
    np.testing.assert_array_equal(mine.same, [True, False] * FOLDS)
    assert mine.folds is None


def test_what_spreadsheets_write(tmp_path: Path) -> None:
    text = table(
        'Path_A, "path_b",SAME',
        '"photos/a1.png", photos/../photos/a2.png ,Yes',
        f"{tmp_path}/photos/a1.png,photos/b1.png,FALSE",
    )
    mine = read(tmp_path, "\ufeff" + text.replace("\n", "\r\n").replace(', "', ',"') + "\r\n,,\r\n")
    assert len(mine) == 2 * FOLDS
    # The absolute path is the same photo as the relative one.
    assert [one.name for one in mine.pictures] == [
        "photos/a1.png",
        "photos/../photos/a2.png",
        "photos/b1.png",
    ]


@pytest.mark.parametrize("start", [0, 1])
def test_folds(tmp_path: Path, start: int) -> None:
    folds = [f",{fold}" for fold in reversed(range(start, start + FOLDS))]
    mine = read(tmp_path, table(f"{HEADER},fold", SAME, OTHER, folds=folds))
    np.testing.assert_array_equal(mine.folds, np.repeat(np.arange(FOLDS)[::-1], 2))


@pytest.mark.parametrize(
    ("folds", "message"),
    [
        (range(11), "has 11 folds; number ten"),
        (range(1, 10), "has 9 folds; number ten"),
        ([11, 0], "line 2 has no fold of 1 to 10"),
        (["x", 0], "line 2 has no fold"),
    ],
)
def test_wrong_folds(tmp_path: Path, folds: list[object], message: str) -> None:
    text = table(f"{HEADER},fold", SAME, OTHER, folds=[f",{fold}" for fold in folds])
    with pytest.raises(DatasetError, match=message):
        read(tmp_path, text)


def test_people(tmp_path: Path) -> None:
    header = f"{HEADER},person_a,person_b"
    mine = read(tmp_path, table(header, f"{SAME},Ann,Ann", f"{OTHER},Ann,Bob"))
    assert mine.people == ("Ann", "Ann", "Bob")
    for same, other, message in (
        (f"{SAME},Ann,Bob", f"{OTHER},Ann,Bob", "line 2 contradicts itself"),
        (f"{SAME},Ann,Ann", f"{OTHER},Eve,Bob", "line 3 has another person on photos/a1.png"),
        (f"{SAME},Ann,", f"{OTHER},Ann,Bob", "line 2 has no name in person_b"),
    ):
        with pytest.raises(DatasetError, match=message):
            read(tmp_path, table(header, same, other))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (table(HEADER, "a,b,perhaps", OTHER), "line 2 has neither 1/true/yes"),
        (table(HEADER, ",b,1", OTHER), "line 2 has no path in path_a"),
        (table(HEADER, "a\0,b,1", OTHER), "line 2 has no path in path_a"),
        (table(HEADER, "a,b", OTHER), "line 2 has 2 cells, not 3"),
        (table(HEADER, '"a"x,b,1', OTHER), "line 2 is not CSV"),
        (table("path_a,path_b", SAME, OTHER), "no column same"),
        (table(f"{HEADER},score", SAME, OTHER), "unknown column 'score'"),
        (table(f"{HEADER},same", SAME, OTHER), "names a column twice"),
        (table(f"{HEADER},person_a", f"{SAME},Ann", f"{OTHER},Ann"), "only one of person_a"),
        (table(HEADER, SAME, OTHER).replace(",", ";"), "save it with commas"),
        (HEADER, "holds no pair"),
        ("", "no column path_a"),
        (table(HEADER, SAME, SAME), "has no pair of two people"),
        (table(HEADER, "x.png,y.png,1", OTHER), "the photo x.png is not there"),
    ],
)
def test_faults_are_listed_by_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        read(tmp_path, text)


def test_a_folder_is_a_template_of_its_photos(tmp_path: Path) -> None:
    mine = read(tmp_path, f"{HEADER}\nphotos,photos/b1.png,1\nphotos/a1.png,photos,0\n")
    assert [one.name for one in mine.pictures] == [
        *("photos/a1.png", "photos/a2.png", "photos/b1.png"),
        *("photos/b1.png", "photos/a1.png"),
    ]
    assert mine.templates == ((0, 1, 2), (3,), (4,))
    assert mine.names == ["photos/a1.png", "photos/b1.png", "photos/a1.png"]
    np.testing.assert_array_equal([mine.first, mine.second], [[0, 2], [1, 0]])
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="empty holds no photo"):
        read(tmp_path, f"{HEADER}\nempty,photos/b1.png,1\nphotos/a1.png,photos,0\n")


@pytest.mark.parametrize(
    "name", ["=SUM(A1)", "-1", "a[1]", "a|b", "a\x1b[31m", "a\udcff", "x" * 101]
)
def test_a_name_that_means_something_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    file = write(tmp_path / f"{name}.csv", table(HEADER, "a,b,1", "a,c,0"))
    with pytest.raises(DatasetError, match="rename the file") as caught:
        open_sets(file, pictures=False)
    assert str(caught.value).isprintable()
