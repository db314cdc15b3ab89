"""InsightFace's ``.bin``: a pickle of encoded photos and of the answers to their pairs."""

from pathlib import Path

import numpy as np

from verify.datasets import DatasetError, faults_in, read_whole
from verify.evaluation.readers.assembly import Trial, assemble
from verify.evaluation.readers.pickled_arrays import PickledArray, RefusedPickle
from verify.evaluation.readers.restricted_pickle import read_pickle
from verify.evaluation.verification_set import (
    PictureBytes,
    VerificationSet,
    contiguous_folds,
    digest_of,
)

MAX_BIN_BYTES = 2 * 2**30

_SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")


def read_bin(path: Path) -> VerificationSet:
    """Read ``(bins, issame_list)``; pair i is ``bins[2 i]`` and ``bins[2 i + 1]``.

    Elements are encoded JPEG or PNG, as bytes, as byte arrays, or as arrays of uint8 with one side
    that is not 1: ``cv2.imencode`` returned a column before OpenCV 4.5.1. Either part may be an
    array of objects instead of a list. Photos are neither decoded nor counted twice: equal
    contents are one photo, named by the place of its first use in ``bins``.

    Raises
    ------
    DatasetError
        Naming what is wrong. Nothing in the file is run, whatever it holds.
    """
    try:
        data = read_whole(path, most=MAX_BIN_BYTES)
        content = read_pickle(data)
    except RefusedPickle as error:
        raise DatasetError(f"{path} is not a readable InsightFace .bin: {error}") from None
    except MemoryError:
        raise DatasetError(f"{path} needs more memory than this machine has") from None
    sha256 = digest_of(data)
    del data
    if not isinstance(content, tuple | list) or len(content) != 2:
        raise DatasetError(f"{path} does not hold the two parts (bins, issame_list)")
    bins, answers = map(_listed, content)
    if not isinstance(bins, tuple | list):
        raise DatasetError(f"{path}: its first part, bins, is not a list of photos")
    same = _answers(path, answers)
    if len(bins) % 2:
        raise DatasetError(f"{path} has an odd number of photos, {len(bins)}; pairs need two each")
    if len(bins) != 2 * len(same):
        raise DatasetError(
            f"{path} has {len(bins)} photos and {len(same)} answers; "
            f"{len(same)} pairs need {2 * len(same)} photos"
        )
    if not same:
        raise DatasetError(f"{path} holds no pair")
    photos = _photos(path, bins)
    named, content_of = _named(photos)
    trials = [
        Trial(named[2 * pair], named[2 * pair + 1], answer, int(fold))
        for pair, (answer, fold) in enumerate(
            zip(same, contiguous_folds(len(same)).tolist(), strict=True)
        )
    ]
    return assemble(
        path.stem.lower(),
        "bin",
        trials,
        picture=lambda name: PictureBytes(name, content_of[name]),
        person=None,
        protocol_files=[(path.name, sha256)],
        aligned=True,
    )


def _listed(part: object) -> object:
    """Look through an array of objects, as ``np.array(photos, dtype=object)`` is."""
    return part.items if isinstance(part, PickledArray) and part.items is not None else part


def _photos(path: Path, bins: tuple[object, ...] | list[object]) -> list[bytes]:
    photos: list[bytes] = []
    faults: list[str] = []
    for place, element in enumerate(bins):
        if isinstance(element, PickledArray):
            flat = max(element.shape, default=0) == len(element.data or b"")
            if element.dtype is None or element.dtype.code != "u1" or not flat:
                faults.append(f"photo {place} is an array, but not one row of bytes (uint8)")
                continue
            element = element.data
        if not isinstance(element, bytes):
            faults.append(f"photo {place} is neither bytes nor an array")
        elif not element.startswith(_SIGNATURES):
            faults.append(f"photo {place} is neither JPEG nor PNG")
        else:
            photos.append(element)
    if faults:
        raise DatasetError(faults_in(path, "expected encoded photos", faults))
    return photos


def _named(photos: list[bytes]) -> tuple[list[str], dict[str, bytes]]:
    """Name every photo by the first place of its content; also return the contents by name.

    A pickle may say one photo a million times at two bytes each. Each object is looked up once,
    so that its bytes are compared once and not each time that it is said.
    """
    names: dict[bytes, str] = {}
    name_of_object: dict[int, str] = {}
    named = []
    for place, photo in enumerate(photos):
        name = name_of_object.get(id(photo))
        if name is None:
            name = names.setdefault(photo, f"{place:05d}")
            name_of_object[id(photo)] = name
        named.append(name)
    return named, {name: photo for photo, name in names.items()}


def _answers(path: Path, answers: object) -> list[bool]:
    if isinstance(answers, PickledArray) and answers.dtype is not None and len(answers.shape) == 1:
        order = answers.dtype.order.replace("=", "<")
        answers = np.frombuffer(answers.data or b"", f"{order}{answers.dtype.code}").tolist()
    if not isinstance(answers, tuple | list):
        raise DatasetError(f"{path}: its second part, issame_list, is not a list")
    wrong = [
        place for place, one in enumerate(answers) if not isinstance(one, int) or one not in (0, 1)
    ]
    if wrong:
        faults = [f"answer {place} is neither true nor false" for place in wrong]
        raise DatasetError(faults_in(path, "expected issame_list of booleans", faults))
    return [bool(one) for one in answers]
