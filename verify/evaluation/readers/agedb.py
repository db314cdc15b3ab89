"""The AgeDB-30 folder: the protocol of 30 years' difference, and its photos."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from models.extraction import Photo
from verify.datasets import SUFFIXES, DatasetError, read_whole
from verify.evaluation.readers.reader import (
    Reader,
    Trial,
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
# The person of "11_AlexKingston_35_f".
_PERSON = re.compile(r"\d+_(.+?)_\d")


def read_agedb(root: Path, pictures: bool) -> list[VerificationSet]:
    """Read ``04_FINAL_protocol_30_years.mat`` and find its photos in ``03_Protocol_Images/``.

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
        found = photos_named(base, keys, protocol=PROTOCOL)
        files = {key: Photo(photo.name, photo) for key, photo in found.items()}
    return [
        assemble(
            "agedb_30",
            "agedb",
            trials,
            pictures=files,
            person=_person,
            protocol_files=[(PROTOCOL, sha256)],
        )
    ]


def read_content(file: Path) -> tuple[list[Trial], str]:
    """Read the variable ``splits`` of the protocol; return its trials and the file's SHA-256.

    ``splits`` holds ten folds. A fold is a struct, or a cell, of a 2 × P cell of photos and of P
    labels, 1 and −1 (or 0). A photo is the name of its file without suffix, or a struct of which
    that is the first field.
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
    splits = content.get("splits", ())
    if np.shape(splits) != (FOLDS,):
        raise DatasetError(f"{file} holds no list of {FOLDS} folds named splits")
    trials: list[Trial] = []
    for fold, part in enumerate(splits):
        try:
            pairs, labels = _members(part)
            first, second = ([_name(photo) for photo in row] for row in pairs)
            same = np.ravel(labels).tolist()
            if set(same) not in ({1, -1}, {1, 0}):
                raise ValueError("it has other labels, or labels of one kind")
            trials += [
                Trial(one, other, label == 1, fold)
                for one, other, label in zip(first, second, same, strict=True)
            ]
        except (TypeError, ValueError) as error:
            raise DatasetError(
                f"{file}: fold {fold + 1} is not a 2 × P cell of names and P labels of 1 and −1: "
                f"{error}"
            ) from None
    return trials, digest_of(data)


def _members(value: Any) -> list[Any]:
    """Return the fields of a struct, or the elements of a cell."""
    if not isinstance(value, np.ndarray | np.void):
        raise TypeError("it is neither a struct nor a cell")
    if not value.dtype.names:
        return list(np.asarray(value))
    fields = [value[name] for name in value.dtype.names]
    return [one.item() if isinstance(one, np.ndarray) and not one.shape else one for one in fields]


def _name(photo: Any) -> str:
    name = photo if isinstance(photo, str) else next(iter(_members(photo)), None)
    if not isinstance(name, str) or not name.strip():
        raise ValueError("it has a photo without a name")
    path = Path(name.strip())
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else name.strip()


def _person(key: str) -> str:
    match = _PERSON.match(key)
    return match[1] if match else key


READER = Reader(
    f"an AgeDB-30 folder ({PROTOCOL} and {PHOTOS}/)",
    lambda path: (path / PROTOCOL).is_file(),
    read_agedb,
)
