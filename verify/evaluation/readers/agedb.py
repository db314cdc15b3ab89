"""The AgeDB-30 folder: the protocol of 30 years' difference, photos and their landmarks."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from verify.datasets import SUFFIXES, DatasetError, faults_in, read_whole
from verify.evaluation.readers.agedb_mat import read_splits
from verify.evaluation.readers.assembly import Trial, assemble, photos_of
from verify.evaluation.readers.lfw import photos_in, suffixes
from verify.evaluation.verification_set import PictureFile, VerificationSet

PROTOCOL = "04_FINAL_protocol_30_years.mat"
PHOTOS = "03_Protocol_Images"
_POINTS = 68
_MAX_PTS_BYTES = 2**16
_TOLERATED = 0.01


def read_agedb(root: Path, *, pictures: bool = True) -> VerificationSet:
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
    protocol = read_splits(root / PROTOCOL)
    trials = [
        Trial(_stem(first), _stem(second), same, fold)
        for fold, pairs in enumerate(protocol.folds)
        for first, second, same in pairs
    ]
    keys = photos_of(trials)
    unsafe = [f"{key!a}" for key in keys if not key.isprintable() or "/" in key or "\\" in key]
    if unsafe:
        raise DatasetError(faults_in(root / PROTOCOL, "expected plain file names", unsafe))
    files = _files(root, keys) if pictures else {}
    return assemble(
        "agedb_30",
        "agedb",
        trials,
        picture=lambda key: files.get(key) or PictureFile(f"{key}.jpg", root / f"{key}.jpg"),
        person=_person_rule(root / PROTOCOL, trials),
        protocol_files=[(PROTOCOL, protocol.sha256)],
    )


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
    return np.stack(
        [
            (points[36] + points[39]) / 2,
            (points[42] + points[45]) / 2,
            points[33],
            points[48],
            points[54],
        ]
    )


def _stem(name: str) -> str:
    dot = name.rfind(".")
    return name[:dot] if dot > 0 and name[dot:].lower() in SUFFIXES else name


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
            f"fold {one.fold + 1} has {one.first} and {one.second} as "
            f"{'one person' if one.same else 'two people'}"
            for one in wrong
        ]
        raise DatasetError(faults_in(file, "expected labels that agree with the names", faults))
    return rule


def _files(root: Path, keys: Sequence[str]) -> dict[str, PictureFile]:
    # Archives are often unpacked into a folder of their own name.
    folders = [root / PHOTOS, root / PHOTOS / PHOTOS]
    listed = next((photos for folder in folders if (photos := photos_in(folder))), {})
    files: dict[str, PictureFile] = {}
    faults: list[str] = []
    for key in keys:
        candidates = listed.get(key, [])
        if len(candidates) == 1:
            photo = candidates[0]
            points = photo.with_suffix(".pts")
            marks = read_pts(points) if points.is_file() else None
            files[key] = PictureFile(photo.name, photo, marks)
        else:
            state = "is not there" if not candidates else "is there with different suffixes"
            faults.append(f"{key} {state}")
    if faults:
        raise DatasetError(
            faults_in(
                root / PHOTOS, f"expected the photos that {PROTOCOL} names ({suffixes()})", faults
            )
        )
    return files
