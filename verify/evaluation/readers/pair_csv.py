"""A list of pairs as CSV, for a user's own photos."""

import csv
import os.path
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from verify.datasets import DatasetError, faults_in
from verify.evaluation.readers.assembly import Trial, assemble, photos_of
from verify.evaluation.readers.protocol_files import read_text
from verify.evaluation.verification_set import PictureFile, VerificationSet, contiguous_folds
from verify.tenfold import FOLDS

REQUIRED = ("path_a", "path_b", "same")
_PEOPLE = ("person_a", "person_b")
_COLUMNS = (*REQUIRED, "fold", *_PEOPLE)
_ANSWERS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
EXPECTED = "expected path_a,path_b,same[,fold][,person_a,person_b]"


@dataclass(frozen=True)
class _Row:
    line: int
    first: str
    second: str
    same: bool
    fold: int | None
    people: tuple[str, str] | None


def read_pair_csv(path: Path, *, pictures: bool = True) -> VerificationSet:
    """Read ``path_a,path_b,same[,fold][,person_a,person_b]``.

    Paths are relative to the file's folder, or absolute. ``same`` is 1, true or yes, or 0, false
    or no. Folds are 1 … 10 or 0 … 9; without them, the pairs in file order are cut into ten runs.

    Raises
    ------
    DatasetError
        Listing every faulty line, or every photo that is absent.
    """
    text = read_text(path, root=path.parent)
    faults: list[str] = []
    rows = _rows(text.text, faults)
    if faults:
        raise DatasetError(faults_in(path, EXPECTED, faults))
    if not rows:
        raise DatasetError(f"{path} holds no pair")
    folds = _folds(path, rows)
    names: dict[str, str] = {}
    for row in rows:
        for cell in (row.first, row.second):
            # Two spellings of one path are one photo, under the first of them.
            names.setdefault(_place(path, cell), cell)
    trials = [
        Trial(names[_place(path, row.first)], names[_place(path, row.second)], row.same, fold)
        for row, fold in zip(rows, folds, strict=True)
    ]
    people = _people(path, rows, trials)
    if pictures:
        absent = [
            f"{name} is not there"
            for name in photos_of(trials)
            if not Path(_place(path, name)).is_file()
        ]
        if absent:
            raise DatasetError(faults_in(path, "expected the photos that it names", absent))
    return assemble(
        path.stem,
        "pairs",
        trials,
        picture=lambda name: PictureFile(name, Path(_place(path, name))),
        person=None if people is None else people.__getitem__,
        protocol_files=[text.fingerprint],
    )


def _place(path: Path, cell: str) -> str:
    return os.path.normpath(path.parent / cell)


def _rows(text: str, faults: list[str]) -> list[_Row]:
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    rows: list[_Row] = []
    try:
        header = [cell.strip().lower() for cell in next(reader, [])]
        if _header_is_wrong(header, faults):
            return []
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                faults.append(f"line {reader.line_num} has {len(cells)} cells, not {len(header)}")
                continue
            row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
            wrong = _faults_of(row)
            if wrong:
                faults.append(f"line {reader.line_num} {' and '.join(wrong)}")
                continue
            rows.append(
                _Row(
                    reader.line_num,
                    row["path_a"],
                    row["path_b"],
                    _ANSWERS[row["same"].lower()],
                    int(row["fold"]) if "fold" in row else None,
                    (row["person_a"], row["person_b"]) if "person_a" in row else None,
                )
            )
    except csv.Error as error:
        faults.append(f"line {reader.line_num} is not CSV ({error})")
    return rows


def _header_is_wrong(header: Sequence[str], faults: list[str]) -> bool:
    before = len(faults)
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        faults.append("line 1 separates its cells by semicolons or tabs; save it with commas")
        return True
    faults += [f"line 1 has no column {name}" for name in REQUIRED if name not in header]
    faults += [f"line 1 has the unknown column {name!a}" for name in header if name not in _COLUMNS]
    if len(set(header)) < len(header):
        faults.append("line 1 names a column twice")
    if len(set(header) & set(_PEOPLE)) == 1:
        faults.append("line 1 has only one of person_a and person_b")
    return len(faults) > before


def _faults_of(row: dict[str, str]) -> list[str]:
    wrong = []
    for column in ("path_a", "path_b"):
        cell = row[column]
        if not cell or not cell.isprintable():
            wrong.append(f"has no path in {column}")
        elif _URL.match(cell):
            wrong.append(f"has a URL in {column}; photos are read from disk only")
    if row["same"].lower() not in _ANSWERS:
        wrong.append("has neither 1/true/yes nor 0/false/no in same")
    fold = row.get("fold", "0")
    if not fold.isascii() or not fold.isdecimal() or len(fold) > 2 or int(fold) > FOLDS:
        wrong.append("has no fold of 1 to 10, or of 0 to 9")
    wrong += [f"has no name in {column}" for column in _PEOPLE if row.get(column) == ""]
    return wrong


def _folds(path: Path, rows: Sequence[_Row]) -> list[int]:
    given = [row.fold for row in rows if row.fold is not None]
    if not given:
        return [int(fold) for fold in contiguous_folds(len(rows))]
    if (0 in given) == (FOLDS in given):
        seen = "both 0 and 10" if 0 in given else "neither 0 nor 10"
        raise DatasetError(
            f"{path} has {seen} in the column fold; number the ten folds 1 to 10, or 0 to 9"
        )
    return [fold - (FOLDS in given) for fold in given]


def _people(path: Path, rows: Sequence[_Row], trials: Sequence[Trial]) -> dict[str, str] | None:
    people: dict[str, str] = {}
    faults: list[str] = []
    for row, trial in zip(rows, trials, strict=True):
        if row.people is None:
            return None
        if (row.people[0] == row.people[1]) != row.same:
            faults.append(f"line {row.line} contradicts itself: its people and same disagree")
        for photo, person in zip((trial.first, trial.second), row.people, strict=True):
            if people.setdefault(photo, person) != person:
                faults.append(f"line {row.line} has another person on {photo} than a line before")
    if faults:
        raise DatasetError(faults_in(path, EXPECTED, faults))
    return people
