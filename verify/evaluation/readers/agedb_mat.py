"""The pairs of AgeDB's protocols, which are MATLAB files of nested cells and structs."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from verify.datasets import DatasetError, read_whole
from verify.evaluation.readers.isolated import isolated
from verify.evaluation.verification_set import digest_of
from verify.tenfold import FOLDS

_MAX_BYTES = 16 * 2**20


@dataclass(frozen=True)
class MatProtocol:
    """Names and labels in file order, fold by fold, and the SHA-256 of the file."""

    folds: tuple[tuple[tuple[str, str, bool], ...], ...]
    sha256: str


def read_splits(file: Path) -> MatProtocol:
    """Read the variable ``splits`` of ``04_FINAL_protocol_30_years.mat``.

    ``splits`` holds ten folds. A fold is a struct, or a cell, of a 2 × P cell of photos and of P
    labels, 1 and −1 (or 0). A photo is the name of its file without suffix, or a struct of which
    that is the first field.

    Raises
    ------
    DatasetError
        The file is not of version 5 to 7, holds no ``splits``, or another layout.
    """
    return isolated(read_content, file)


def read_content(file: Path) -> MatProtocol:
    """Read as :func:`read_splits` does, in this process."""
    data = read_whole(file, most=_MAX_BYTES)
    try:
        stream: Any = io.BytesIO(data)
        content = scipy.io.loadmat(stream, variable_names=["splits"], squeeze_me=True)
    except NotImplementedError:
        raise DatasetError(
            f"{file} is of MATLAB 7.3, and versions 5 to 7 are read: save it again with '-v7'"
        ) from None
    except MemoryError:
        raise
    except Exception as error:  # SciPy raises whatever a broken file causes
        raise DatasetError(f"{file} is cut off or damaged ({type(error).__name__})") from None
    if "splits" not in content:
        raise DatasetError(f"{file} holds no variable named splits")
    parts = content["splits"]
    if np.shape(parts) != (FOLDS,):
        raise DatasetError(f"{file}: splits is not a list of {FOLDS} folds")
    folds = []
    for number, part in enumerate(parts, start=1):
        try:
            folds.append(_fold(part))
        except (TypeError, ValueError) as error:
            raise DatasetError(
                f"{file}: fold {number} is not a 2 × P cell of names and P labels of 1 and −1: "
                f"{error}"
            ) from None
    return MatProtocol(tuple(folds), digest_of(data))


def _fold(part: Any) -> tuple[tuple[str, str, bool], ...]:
    pairs, labels = _parts(part)
    first, second = ([_name(photo) for photo in row] for row in pairs)
    labels = np.ravel(labels)
    if set(labels.tolist()) not in ({1, -1}, {1, 0}):
        raise ValueError("it has other labels, or labels of one kind")
    return tuple(zip(first, second, (labels == 1).tolist(), strict=True))


def _parts(value: Any) -> list[Any]:
    """Return the fields of a struct, or the elements of a cell."""
    if not isinstance(value, np.ndarray | np.void):
        raise TypeError("it is neither a struct nor a cell")
    if not value.dtype.names:
        return list(np.asarray(value))
    fields = [value[name] for name in value.dtype.names]
    return [
        field.item() if isinstance(field, np.ndarray) and not field.shape else field
        for field in fields
    ]


def _name(photo: Any) -> str:
    name = photo if isinstance(photo, str) else next(iter(_parts(photo)), None)
    if not isinstance(name, str) or not name.strip():
        raise ValueError("it has a photo without a name")
    return name.strip()
