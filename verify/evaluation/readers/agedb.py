"""The AgeDB-30 folder: the protocol of 30 years' difference, photos and their landmarks."""

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.extraction import Photo
from verify.datasets import SUFFIXES, DatasetError, Trial, faults_in, read_whole
from verify.evaluation.readers.reader import (
    Reader,
    assemble,
    isolated,
    keys_of,
    photos_named,
    require_plain_names,
)
from verify.evaluation.verification_set import VerificationSet, digest_of
from verify.tenfold import FOLDS

PROTOCOL = "04_FINAL_protocol_30_years.mat"
PHOTOS = "03_Protocol_Images"
_MAX_MAT_BYTES = 16 * 2**20
_POINTS = 68
_MAX_PTS_BYTES = 2**16
_TOLERATED = 0.01


def read_agedb(root: Path, pictures: bool) -> list[VerificationSet]:
    """Read ``04_FINAL_protocol_30_years.mat`` and find its photos in ``03_Protocol_Images/``.

    The person is read off the file name: of ``11_AlexKingston_35_f`` the words before the first
    number after the index, or of names with an identity in front that identity; whichever
    agrees with the labels of more pairs.

    Raises
    ------
    DatasetError
        The protocol has another layout, photos are absent (all listed), or the names of the
        people contradict more than one label in a hundred, as shuffled labels would.

    References
    ----------
    Moschoglou et al., "AgeDB: the first manually collected, in-the-wild age database", CVPRW 2017.
    """
    trials, sha256 = isolated(read_content, root / PROTOCOL)
    keys = keys_of(trials)
    require_plain_names(root / PROTOCOL, keys)
    files = {key: Photo(f"{key}.jpg", root / f"{key}.jpg") for key in keys}
    if pictures:
        # Archives are often unpacked into a folder of their own name.
        inner = root / PHOTOS / PHOTOS
        base = inner if inner.is_dir() else root / PHOTOS
        for key, photo in photos_named(base, keys, protocol=PROTOCOL).items():
            points = photo.with_suffix(".pts")
            marks = read_pts(points) if points.is_file() else None
            files[key] = Photo(photo.name, photo, marks)
    return [
        assemble(
            "agedb_30",
            "agedb",
            trials,
            pictures=files,
            person=_person_rule(root / PROTOCOL, trials),
            protocol_files=[(PROTOCOL, sha256)],
        )
    ]


def read_content(file: Path) -> tuple[list[Trial], str]:
    """Read the variable ``splits`` of the protocol; return its trials and the file's SHA-256.

    ``splits`` holds ten folds. A fold is a struct, or a cell, of a 2 × P cell of photos and of P
    labels, 1 and −1 (or 0). A photo is the name of its file without suffix, or a struct of which
    that is the first field.

    Raises
    ------
    DatasetError
        The file is not of version 5 to 7, holds no ``splits``, or another layout.
    """
    from scipy.io import loadmat

    data = read_whole(file, most=_MAX_MAT_BYTES)
    try:
        stream: Any = io.BytesIO(data)
        content = loadmat(stream, variable_names=["splits"], squeeze_me=True)
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
    if np.shape(content["splits"]) != (FOLDS,):
        raise DatasetError(f"{file}: splits is not a list of {FOLDS} folds")
    trials: list[Trial] = []
    for fold, part in enumerate(content["splits"]):
        try:
            trials += _fold(part, fold)
        except (TypeError, ValueError) as error:
            raise DatasetError(
                f"{file}: fold {fold + 1} is not a 2 × P cell of names and P labels of 1 and −1: "
                f"{error}"
            ) from None
    return trials, digest_of(data)


def _fold(part: Any, fold: int) -> list[Trial]:
    pairs, labels = _parts(part)
    first, second = ([_name(photo) for photo in row] for row in pairs)
    labels = np.ravel(labels)
    if set(labels.tolist()) not in ({1, -1}, {1, 0}):
        raise ValueError("it has other labels, or labels of one kind")
    return [
        Trial(one, other, label == 1, fold)
        for one, other, label in zip(first, second, labels.tolist(), strict=True)
    ]


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
    path = Path(name.strip())
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else name.strip()


def read_pts(file: Path) -> NDArray[np.float64]:
    """Read five landmarks from a 68-point ``.pts`` file.

    Returns
    -------
    points : (5, 2) float64
        x and y in pixels, as written: left eye (mean of points 36 and 39, counted from 0), right
        eye (42 and 45), nose (33), left and right mouth corner (48 and 54), left and right as
        seen in the picture.

    Raises
    ------
    DatasetError
        The file does not hold 68 finite points between braces.

    References
    ----------
    Sagonas et al., "300 Faces in-the-Wild Challenge", ICCVW 2013: the 68 points and the format.
    """
    text = read_whole(file, most=_MAX_PTS_BYTES).decode("ascii", "replace")
    body = text.partition("{")[2].partition("}")[0]
    try:
        points = np.array([line.split() for line in body.splitlines() if line.strip()], np.float64)
    except ValueError:
        points = np.empty((0, 2))
    if points.shape != (_POINTS, 2) or not np.isfinite(points).all() or not np.ptp(points):
        raise DatasetError(f"{file} does not hold {_POINTS} points in braces, not all equal")
    eyes = (points[36] + points[39]) / 2, (points[42] + points[45]) / 2
    return np.stack([*eyes, points[33], points[48], points[54]])


def _identity(key: str) -> str:
    return key.split("_")[0]


def _words(key: str) -> str:
    parts = key.split("_")[1:]
    number = next((place for place, part in enumerate(parts) if part.isdecimal()), len(parts))
    return "_".join(parts[:number]) or key


def _person_rule(file: Path, trials: Sequence[Trial]) -> Callable[[str], str]:
    def contradictions(person: Callable[[str], str]) -> list[Trial]:
        return [one for one in trials if (person(one.first) == person(one.second)) != one.same]

    rule = min((_words, _identity), key=lambda person: len(contradictions(person)))
    wrong = contradictions(rule)
    if len(wrong) > _TOLERATED * len(trials):
        faults = [
            f"fold {(one.fold or 0) + 1} has {one.first} and {one.second} as "
            f"{'one person' if one.same else 'two people'}"
            for one in wrong
        ]
        raise DatasetError(faults_in(file, "expected labels that agree with the names", faults))
    return rule


READER = Reader(
    f"an AgeDB-30 folder ({PROTOCOL} and {PHOTOS}/)",
    lambda path: (path / PROTOCOL).is_file(),
    read_agedb,
)
