"""LFW, CFP and AgeDB-30 folders, laid out as published."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from tests.verify.evaluation.layouts import (
    AGEDB_NAMES,
    agedb_folder,
    agedb_folds,
    agedb_splits,
    cfp_folder,
    lfw_folder,
    write,
)
from verify import DatasetError
from verify.evaluation.readers import open_sets
from verify.evaluation.readers.agedb import PROTOCOL, read_content
from verify.evaluation.verification_set import VerificationSet
from verify.tenfold import FOLDS

pytestmark = pytest.mark.usefixtures("in_this_process")


def pairs_of(benchmark: VerificationSet) -> list[tuple[str, str, bool, int]]:
    names = [picture.name for picture in benchmark.pictures]
    return [
        (names[first], names[second], bool(same), int(fold))
        for first, second, same, fold in zip(
            benchmark.first, benchmark.second, benchmark.same, benchmark.folds, strict=True
        )
    ]


# LFW


@pytest.mark.parametrize("inside", ["", "lfw"])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".JPEG", ".webp"])
def test_lfw(tmp_path: Path, inside: str, suffix: str) -> None:
    (lfw,) = open_sets(lfw_folder(tmp_path, inside=inside, suffix=suffix))
    one, two, bob = (
        f"{who}/{who}_{n:04d}{suffix}" for who, n in (("Ann", 1), ("Ann", 2), ("Bob", 1))
    )
    expected = [pair for f in range(FOLDS) for pair in ((one, two, True, f), (two, bob, False, f))]
    assert pairs_of(lfw) == expected
    assert lfw.people == ("Ann", "Ann", "Bob")
    assert (lfw.name, lfw.kind, lfw.aligned) == ("lfw", "lfw", None)
    assert lfw.pictures[2].read() == (tmp_path / inside / bob).read_bytes()


def test_lfw_without_photos(tmp_path: Path) -> None:
    lfw_folder(tmp_path, photos=False)
    (lfw,) = open_sets(tmp_path, pictures=False)
    assert lfw.pictures[0].name == "Ann/Ann_0001.jpg"
    with pytest.raises(DatasetError, match=r"photo Ann/Ann_0001 of pairs\.txt is not there"):
        open_sets(tmp_path)


def test_a_photo_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    write(lfw_folder(tmp_path) / "Bob/Bob_0001.png", b"x")
    with pytest.raises(DatasetError, match=r"Bob/Bob_0001 of pairs\.txt is there 2 times"):
        open_sets(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("10\t1", "9\t1", "has 9 folds"),
        ("10\t1", "10", "does not begin with"),
        ("10\t1", "10\t2", "promises 40 pairs and holds 20"),
        ("Ann\t1\t2", "Ann\t1", "line 2 is not of the form Name i j"),
        ("Bob\t1", "Bob\tx", "line 3 is not of the form NameA"),
        ("Bob\t1", "../Bob\t1", "no plain name"),
        ("Ann\t1\t2", "Ann\t1\t1", "Ann_0001 compares a photo with itself"),
        ("Bob\t1", "Ann\t1", "labelled as two people, which its names contradict"),
    ],
)
def test_lfw_broken_protocols(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = lfw_folder(tmp_path) / "pairs.txt"
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(DatasetError, match=message):
        open_sets(tmp_path)


def test_real_lfw(lfw_aligned: Path) -> None:
    (lfw,) = open_sets(lfw_aligned)
    assert (len(lfw), len(lfw.pictures), lfw.genuine) == (6000, 7701, 3000)


# CFP


def test_cfp(tmp_path: Path) -> None:
    sets = open_sets(cfp_folder(tmp_path))
    fold = [(1, 2, True), (3, 4, True), (1, 3, False), (2, 6, False)]
    for one, (name, poses) in zip(
        sets,
        {"cfp_ff": ("frontal", "frontal"), "cfp_fp": ("frontal", "profile")}.items(),
        strict=True,
    ):
        assert (one.name, one.kind) == (name, "cfp")
        expected = [
            (
                *(
                    f"Data/Images/{(k + 1) // 2:03d}/{pose}/{2 - k % 2:02d}.jpg"
                    for k, pose in zip((i, j), poses, strict=True)
                ),
                same,
            )
            for i, j, same in fold
        ]
        assert pairs_of(one) == [(*pair, f) for f in range(FOLDS) for pair in expected]
        for picture in one.pictures:
            assert picture.read() == (tmp_path / picture.name).read_bytes()
    assert sets[1].people == ("001", "001", "002", "002", "002", "001", "003")
    assert [file for file, _ in sets[0].protocol_files][:2] == [
        "Protocol/Pair_list_F.txt",
        "Protocol/Split/FF/01/same.txt",
    ]


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (
            "Split/FF/01/same.txt",
            "1,7\n3,4",
            r"FF/01/same.txt line 1 has the index 7; its list has 1 to 6",
        ),
        ("Split/FF/01/same.txt", "0,1\n3,4", "has the index 0"),
        ("Split/FF/01/same.txt", "1,3\n3,4", "pairs 001 and 002 as one person"),
        ("Split/FP/10/diff.txt", "\n1,2", "FP/10/diff.txt line 2 pairs 001 and 001 as two people"),
        ("Split/FP/10/diff.txt", "1;2", "is not of the form i,j"),
        (
            "Pair_list_P.txt",
            "1 ../Data/Images/001/profile/01.jpg\n3 ../a/001/profile/2.jpg",
            "line 2 is not of the form: 2 …/identity/profile/photo",
        ),
        ("Pair_list_P.txt", "1 ../a/001/frontal/1.jpg", "line 1 is not of the form"),
        ("Pair_list_P.txt", "1 ../../../001/profile/1.jpg", "line 1 is not of the form"),
        ("Pair_list_P.txt", "one two", "line 1 is not of the form"),
        ("Pair_list_P.txt", "", "lists no photo"),
    ],
)
def test_cfp_broken_protocols(tmp_path: Path, file: str, text: str, message: str) -> None:
    write(cfp_folder(tmp_path) / "Protocol" / file, text)
    with pytest.raises(DatasetError, match=message):
        open_sets(tmp_path)


def test_a_split_that_is_absent_is_named(tmp_path: Path) -> None:
    cfp_folder(tmp_path)
    (tmp_path / "Protocol/Split/FP/07/diff.txt").unlink()
    with pytest.raises(DatasetError, match=r"FP/07/diff.txt is not there"):
        open_sets(tmp_path)


# AgeDB-30


@pytest.mark.parametrize("layout", ["structs", "cells"])
@pytest.mark.parametrize("compressed", [False, True])
def test_agedb(tmp_path: Path, layout: str, compressed: bool) -> None:
    (agedb,) = open_sets(agedb_folder(tmp_path, layout=layout, compressed=compressed))
    expected = [
        (f"{first}.jpg", f"{second}.jpg", label == 1, fold)
        for fold, pairs in enumerate(agedb_folds())
        for first, second, label in pairs
    ]
    assert pairs_of(agedb) == expected
    assert (agedb.name, agedb.kind) == ("agedb_30", "agedb")
    assert agedb.people == ("AnnBell", "AnnBell", "BobHay")


@pytest.mark.parametrize(
    ("last", "message"),
    [
        (None, "no list of 10 folds"),
        ([("a", "b", 5), ("a", "c", 1)], "fold 10 .*other labels"),
        ([("a", "b", 0), ("a", "b", -1), ("a", "a", 1)], "fold 10 .*other labels"),
        ([("a", " ", -1), ("a", "a", 1)], "fold 10 .*photo without a name"),
        ([("a/b", "c", 1), ("a", "c", -1)], "no plain name"),
        ([(*AGEDB_NAMES[1:], 1), (*AGEDB_NAMES[:2], -1)], "as one person, which its names"),
    ],
)
def test_agedb_wrong_protocols(
    tmp_path: Path, last: list[tuple[str, str, int]] | None, message: str
) -> None:
    agedb_folder(tmp_path, folds=agedb_folds()[:9] + ([] if last is None else [last]))
    with pytest.raises(DatasetError, match=message):
        open_sets(tmp_path)


@pytest.mark.parametrize(
    "part", [np.empty((2, 0), dtype=object), {"pairs": np.empty((2, 0), dtype=object)}, "a", 1.0]
)
def test_agedb_an_empty_fold_is_refused(tmp_path: Path, part: object) -> None:
    splits = agedb_splits("structs", agedb_folds())
    splits[4, 0] = part
    agedb_folder(tmp_path)
    scipy.io.savemat(tmp_path / PROTOCOL, {"splits": splits})
    with pytest.raises(DatasetError, match="fold 5 "):
        open_sets(tmp_path)


def test_agedb_broken_files(tmp_path: Path) -> None:
    file = agedb_folder(tmp_path, compressed=True) / PROTOCOL
    data = file.read_bytes()
    for end in range(0, len(data), 41):
        file.write_bytes(data[:end])
        with pytest.raises(DatasetError):
            read_content(file)
    file.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(600))
    with pytest.raises(DatasetError, match="save it again"):
        open_sets(tmp_path)
    scipy.io.savemat(file, {"other": np.zeros(3)})
    with pytest.raises(DatasetError, match="no list of 10 folds named splits"):
        open_sets(tmp_path)


# Recognition


def test_other_folders_and_files_are_described(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for path, message in (
        (tmp_path / "absent", "is not there. Understood are"),
        (tmp_path / "empty", "a folder with nothing in it"),
        (write(tmp_path / "notes.md", "x"), "file of another kind"),
        (lfw_folder(tmp_path / "lfw") / "pairs.txt", "a set in a folder, give the folder"),
        (tmp_path, "a folder with empty, lfw, notes.md in it"),
    ):
        with pytest.raises(DatasetError, match=message) as caught:
            open_sets(path)
        assert all(kind in str(caught.value) for kind in (".bin", "CSV", "LFW", "CFP", "AgeDB"))


def test_two_protocols_in_one_folder(tmp_path: Path) -> None:
    cfp_folder(lfw_folder(tmp_path))
    with pytest.raises(
        DatasetError, match=r"a CFP folder .* and an LFW folder .*: which one is it"
    ):
        open_sets(tmp_path)
