"""From trials that name their photos to a verification set."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from verify.datasets import DatasetError
from verify.evaluation.verification_set import (
    Picture,
    VerificationSet,
    require_both_classes,
)

_LONGEST_NAME = 100
# A spreadsheet runs a cell that begins so; Markdown, tables and figures have meanings for the rest.
_FORMULAS = ("=", "+", "-", "@")
_MARKUP = frozenset("[]$|`")


@dataclass(frozen=True)
class Trial:
    """One comparison of a protocol; photos by a key that is unique in the set."""

    first: str
    second: str
    same: bool
    fold: int


def photos_of(trials: Iterable[Trial]) -> list[str]:
    """Keys of the photos, each once, in the order of their first use."""
    return list(dict.fromkeys(key for trial in trials for key in (trial.first, trial.second)))


def assemble(
    name: str,
    kind: str,
    trials: Sequence[Trial],
    *,
    picture: Callable[[str], Picture],
    person: Callable[[str], str] | None,
    protocol_files: Iterable[tuple[str, str]],
    aligned: bool | None = None,
) -> VerificationSet:
    """Number the photos of ``trials`` and check that every fold has both kinds of pairs.

    Parameters
    ----------
    picture, person
        The photo of a key, and the name of the person on it.

    Raises
    ------
    DatasetError
        A fold lacks genuine or impostor pairs, or a name cannot stand in tables and figures.
    """
    protocol_files = tuple(protocol_files)
    _require_plain(name, [file for file, _ in protocol_files])
    keys = photos_of(trials)
    position = {key: place for place, key in enumerate(keys)}
    same = np.array([trial.same for trial in trials], dtype=np.bool_)
    folds = np.array([trial.fold for trial in trials], dtype=np.int64)
    require_both_classes(name, same, folds)
    return VerificationSet(
        name=name,
        kind=kind,
        pictures=tuple(picture(key) for key in keys),
        first=np.array([position[trial.first] for trial in trials], dtype=np.int64),
        second=np.array([position[trial.second] for trial in trials], dtype=np.int64),
        same=same,
        folds=folds,
        people=None if person is None else tuple(person(key) for key in keys),
        protocol_files=protocol_files,
        aligned=aligned,
    )


def _require_plain(name: str, files: Sequence[str]) -> None:
    """Refuse a name that would mean something in CSV, Markdown, a figure or the terminal."""
    if len(name) > _LONGEST_NAME:
        raise DatasetError(
            f"the set {name[:_LONGEST_NAME]!a} … has a name of more than {_LONGEST_NAME} "
            "characters; rename the file"
        )
    for text in (name, *files):
        # What is printable can be encoded: halves of surrogate pairs are not.
        if not text.isprintable():
            raise DatasetError(
                f"the set {text!a} has a name with characters that are not printable; rename the "
                "file"
            )
    if name.startswith(_FORMULAS) or _MARKUP & set(name):
        raise DatasetError(
            f"the set {name!a} has a name that begins with one of {' '.join(_FORMULAS)}, or holds "
            f"one of {' '.join(sorted(_MARKUP))}; rename the file"
        )
