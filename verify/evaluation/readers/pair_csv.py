"""A list of pairs as CSV, for a user's own photos: with folds or without, of photos or folders."""

import os.path
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from models.extraction import Photo
from verify.datasets import DatasetError, csv_rows, is_photo, visible
from verify.evaluation.readers.reader import Reader, Trial, assemble, keys_of, read_text
from verify.evaluation.verification_set import VerificationSet
from verify.tenfold import FOLDS

REQUIRED = ("path_a", "path_b", "same")
_PEOPLE = ("person_a", "person_b")
_ANSWERS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


def read_pair_csv(path: Path, pictures: bool) -> list[VerificationSet]:
    """Read ``path_a,path_b,same[,fold][,person_a,person_b]``.

    Paths are relative to the file's folder, or absolute. A path of a folder is a template of all
    photos in it, whose embeddings are averaged. ``same`` is 1, true or yes, or 0, false or no.
    Folds are 1 … 10 or 0 … 9; without the column the set has none, and so no accuracy.
    """
    text = read_text(path, root=path.parent)
    names: dict[str, str] = {}
    trials: list[Trial] = []
    people: dict[str, str] = {}
    for where, row in csv_rows(path, text.text, required=REQUIRED, optional=("fold", *_PEOPLE)):
        if fault := _fault_of(row):
            raise DatasetError(f"{where} {fault}")
        # Two spellings of one path are one photo, under the first of them.
        first, second = (
            names.setdefault(_place(path, row[column]), row[column])
            for column in ("path_a", "path_b")
        )
        same = _ANSWERS[row["same"].lower()]
        trials.append(Trial(first, second, same, int(row["fold"]) if "fold" in row else None))
        for photo, column in zip((first, second), _PEOPLE, strict=True):
            if column in row and people.setdefault(photo, row[column]) != row[column]:
                raise DatasetError(f"{where} has another person on {photo} than a line before")
        if "person_a" in row and (row["person_a"] == row["person_b"]) != same:
            raise DatasetError(f"{where} contradicts itself: its people and same disagree")
    if not trials:
        raise DatasetError(f"{path} holds no pair")
    templates = {}
    for name in keys_of(trials):
        folder = Path(_place(path, name))
        if folder.is_dir():
            photos = [file for file in visible(folder) if is_photo(file)]
            templates[name] = [Photo(f"{name}/{file.name}", file) for file in photos]
            if not photos:
                raise DatasetError(f"{path}: the folder {name} holds no photo")
        elif pictures and not folder.is_file():
            raise DatasetError(f"{path}: the photo {name} is not there")
    return [
        assemble(
            path.stem,
            "pairs",
            _from_zero(path, trials),
            pictures=lambda name: Photo(name, Path(_place(path, name))),
            person=people.__getitem__ if people else None,
            protocol_files=[text.fingerprint],
            templates=templates,
        )
    ]


def _place(path: Path, cell: str) -> str:
    return os.path.normpath(path.parent / cell)


def _fault_of(row: dict[str, str]) -> str | None:
    for column in ("path_a", "path_b"):
        if not row[column] or not row[column].isprintable():
            return f"has no path in {column}"
    if row["same"].lower() not in _ANSWERS:
        return "has neither 1/true/yes nor 0/false/no in same"
    fold = row.get("fold", "0")
    if not fold.isascii() or not fold.isdecimal() or len(fold) > 2 or int(fold) > FOLDS:
        return "has no fold of 1 to 10, or of 0 to 9"
    if len(row.keys() & {*_PEOPLE}) == 1:
        return "has only one of person_a and person_b"
    nameless = [column for column in _PEOPLE if row.get(column) == ""]
    return f"has no name in {nameless[0]}" if nameless else None


def _from_zero(path: Path, trials: Sequence[Trial]) -> list[Trial]:
    """Number the folds from 0."""
    folds = sorted({trial.fold for trial in trials if trial.fold is not None})
    if folds and folds != [*range(folds[0], folds[0] + FOLDS)]:
        raise DatasetError(f"{path} has {len(folds)} folds; number ten of them 1 to 10, or 0 to 9")
    return [
        replace(trial, fold=None if trial.fold is None else folds.index(trial.fold))
        for trial in trials
    ]


READER = Reader(
    "a pair CSV (path_a,path_b,same[,fold])",
    lambda path: path.suffix.lower() == ".csv" and path.is_file(),
    read_pair_csv,
)
