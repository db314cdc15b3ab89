"""The pairs of AgeDB's protocols, which are MATLAB files of nested cells and structs."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from verify.datasets import DatasetError, faults_in, read_whole
from verify.evaluation.readers.mat5 import RefusedMat, read_variable
from verify.evaluation.verification_set import digest_of
from verify.tenfold import FOLDS

_MAX_BYTES = 16 * 2**20
_DEEPEST = 8


@dataclass(frozen=True)
class MatProtocol:
    """Names and labels in file order, fold by fold, and the SHA-256 of the file."""

    folds: tuple[tuple[tuple[str, str, bool], ...], ...]
    sha256: str


def read_splits(file: Path) -> MatProtocol:
    """Read the variable ``splits`` of ``04_FINAL_protocol_30_years.mat``.

    Accepted for ``splits`` are ten cells or a struct array of ten, one per fold. A fold is

    - a struct, or a cell, of the photos (a 2 × P or P × 2 cell, or two cells of P) and of P
      labels; this is how public converters of the published file read it: 2 × 600 photos, each a
      struct whose first field is the file name without suffix, and 1 × 600 labels; or
    - a P × 3 or 3 × P cell of name, name and label.

    A name is text, or a struct whose first text field is the name; labels are 1 and −1, or 1
    and 0. Single-element wrappers at any level are looked through.

    Raises
    ------
    DatasetError
        The file is not of version 5 to 7, holds no ``splits``, or another layout.
    """
    data = read_whole(file, most=_MAX_BYTES)
    try:
        content = read_variable(data, "splits")
    except RefusedMat as error:
        raise DatasetError(f"{file} is not readable: {error}") from None
    if content is None:
        raise DatasetError(f"{file} holds no variable named splits")
    parts = _elements(_unwrap(content))
    if len(parts) != FOLDS:
        raise DatasetError(f"{file}: splits has {len(parts)} folds; the protocol has {FOLDS}")
    folds: list[tuple[tuple[str, str, bool], ...]] = []
    faults: list[str] = []
    for number, part in enumerate(parts, start=1):
        try:
            folds.append(_fold(part))
        except _Layout as error:
            faults.append(f"fold {number} {error}")
    if faults:
        raise DatasetError(faults_in(file, "expected names and labels in ten folds", faults))
    return MatProtocol(tuple(folds), digest_of(data))


class _Layout(Exception):
    """A part of the file that is laid out otherwise; the message says how."""


def _unwrap(value: object) -> object:
    """Look through cells and struct arrays of one element."""
    for _ in range(_DEEPEST):
        if isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "OV":
            value = value.reshape(-1)[0]
        else:
            break
    return value


def _elements(value: object) -> list[object]:
    """Elements of a cell or struct array, in column order as MATLAB counts them."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "OV":
        return list(value.reshape(-1, order="F"))
    return [value]


def _fold(value: object) -> tuple[tuple[str, str, bool], ...]:
    value = _unwrap(value)
    if isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind == "O":
        for first, second, last in _columns(value, 3) if value.size else ():
            # A 3 × 3 cell could be either way round: the labels are no names.
            if _is_name(first[-1]) and _is_name(second[-1]) and not any(map(_is_name, last)):
                return _trials(_names(first), _names(second), _labels(last))
    if isinstance(value, np.void) and value.dtype.names:
        parts: list[object] = [value[name] for name in value.dtype.names]
    else:
        parts = _elements(value)
    names: list[list[str]] = []
    labels: list[int] | None = None
    for part in parts:
        if isinstance(part, np.ndarray) and part.dtype.kind in "iufb" and labels is None:
            labels = _labels(list(part.reshape(-1)))
        elif isinstance(part, np.ndarray) and part.dtype.kind in "OV" and part.size:
            names += _photo_columns(part)
    if len(names) != 2 or labels is None:
        raise _Layout("does not hold two columns of names and one of labels")
    return _trials(names[0], names[1], labels)


def _photo_columns(part: NDArray[np.generic]) -> list[list[str]]:
    """Two columns of names, or one; none where the cell holds something else."""
    columns: list[list[object]] = next(_columns(part, 2), [list(part.reshape(-1))])
    if all(_is_name(column[0]) for column in columns):
        return [_names(column) for column in columns]
    return []


def _columns(cell: NDArray[np.generic], count: int) -> Iterator[list[list[object]]]:
    """Rows of a ``count`` × P cell, then columns of a P × ``count`` cell."""
    for table in (cell, cell.T):
        if cell.ndim == 2 and table.shape[0] == count:
            yield [list(row) for row in table]


def _name_of(value: object) -> str | None:
    value = _unwrap(value)
    if isinstance(value, np.void) and value.dtype.names:
        texts = (_name_of(value[name]) for name in value.dtype.names)
        return next((text for text in texts if text is not None), None)
    if isinstance(value, np.ndarray) and value.dtype.kind == "U" and value.size == 1:
        value = value.reshape(-1)[0]
    return str(value).strip() if isinstance(value, str) and value.strip() else None


def _is_name(value: object) -> bool:
    return _name_of(value) is not None


def _names(column: list[object]) -> list[str]:
    names = [_name_of(value) for value in column]
    if None in names:
        raise _Layout(f"has no name at pair {names.index(None) + 1}")
    return [name for name in names if name is not None]


def _labels(column: list[object]) -> list[int]:
    labels: list[int] = []
    for place, value in enumerate(column, start=1):
        number = np.asarray(_unwrap(value)).reshape(-1)
        if number.size != 1 or number.dtype.kind not in "iufb" or number[0] not in (1, 0, -1):
            raise _Layout(f"has a label at pair {place} that is neither 1 nor −1")
        labels.append(int(number[0]))
    if {0, -1} <= set(labels):
        raise _Layout("mixes the labels 0 and −1")
    return labels


def _trials(
    first: list[str], second: list[str], labels: list[int]
) -> tuple[tuple[str, str, bool], ...]:
    if not len(first) == len(second) == len(labels):
        raise _Layout(f"has {len(first)} and {len(second)} names and {len(labels)} labels")
    if not labels:
        raise _Layout("is empty")
    return tuple(zip(first, second, (label == 1 for label in labels), strict=True))
