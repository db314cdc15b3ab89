"""InsightFace's ``.bin``: a pickle of encoded photos and of the answers to their pairs."""

from collections.abc import Sequence
from pathlib import Path

from verify.datasets import DatasetError, read_whole
from verify.evaluation.readers.assembly import Trial, assemble
from verify.evaluation.readers.isolated import isolated
from verify.evaluation.readers.plain_pickle import PickledArray, RefusedPickle, read_pickle
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
    photos, same, sha256 = isolated(read_content, path)
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


def read_content(path: Path) -> tuple[list[bytes], list[bool], str]:
    """Return the photos, the answers and the SHA-256 of a file.

    Raises
    ------
    DatasetError
        As of :func:`read_bin`.
    """
    data = read_whole(path, most=MAX_BIN_BYTES)
    try:
        content = read_pickle(data)
        if not isinstance(content, tuple | list) or len(content) != 2:
            raise DatasetError(f"{path} does not hold the two parts (bins, issame_list)")
        bins, answers = map(_listed, content)
    except RefusedPickle as error:
        raise DatasetError(f"{path} is not a readable InsightFace .bin: {error}") from None
    if not isinstance(bins, tuple | list):
        raise DatasetError(f"{path}: its first part, bins, is not a list of photos")
    if not isinstance(answers, tuple | list):
        raise DatasetError(f"{path}: its second part, issame_list, is not a list")
    if len(bins) % 2:
        raise DatasetError(f"{path} has an odd number of photos, {len(bins)}; pairs need two each")
    if len(bins) != 2 * len(answers):
        raise DatasetError(
            f"{path} has {len(bins)} photos and {len(answers)} answers; "
            f"{len(answers)} pairs need {2 * len(answers)} photos"
        )
    if not answers:
        raise DatasetError(f"{path} holds no pair")
    for place, answer in enumerate(answers):
        if not isinstance(answer, int) or answer not in (0, 1):
            raise DatasetError(f"{path}: answer {place} is neither true nor false")
    return _photos(path, bins), [bool(answer) for answer in answers], digest_of(data)


def _listed(part: object) -> object:
    """Return the elements of an array: numbers, or objects as of ``np.array(…, dtype=object)``."""
    if not isinstance(part, PickledArray):
        return part
    if isinstance(part.content, list):
        return part.content
    return part.type.numbers(part.content) if len(part.shape) == 1 else None


def _photos(path: Path, bins: Sequence[object]) -> list[bytes]:
    photos: list[bytes] = []
    for place, element in enumerate(bins):
        if isinstance(element, PickledArray):
            row = max(element.shape, default=0) == len(element.content)
            if element.type.code != "u1" or not row:
                raise DatasetError(f"{path}: photo {place} is an array, but not one row of uint8")
            element = element.content
        if not isinstance(element, bytes | bytearray):
            raise DatasetError(f"{path}: photo {place} is neither bytes nor an array")
        if not element.startswith(_SIGNATURES):
            raise DatasetError(f"{path}: photo {place} is neither JPEG nor PNG")
        # Bytes that are said again stay one object, here and on their way out of the process.
        photos.append(element if isinstance(element, bytes) else bytes(element))
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
