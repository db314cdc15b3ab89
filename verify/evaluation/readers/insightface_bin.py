"""InsightFace's ``.bin``: a pickle of encoded photos and of the answers to their pairs."""

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from models.extraction import Photo
from verify.datasets import DatasetError, read_whole
from verify.evaluation.readers.reader import Reader, Trial, assemble, isolated
from verify.evaluation.verification_set import (
    VerificationSet,
    contiguous_folds,
    digest_of,
)

MAX_BIN_BYTES = 2 * 2**30

_SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")


def read_bin(path: Path, _: bool) -> list[VerificationSet]:
    """Read ``(bins, issame_list)``; pair i is ``bins[2 i]`` and ``bins[2 i + 1]``.

    Elements are encoded JPEG or PNG, as bytes, as byte arrays, or as arrays of uint8 with one side
    that is not 1: ``cv2.imencode`` returned a column before OpenCV 4.5.1. Either part may be an
    array of objects instead of a list. Equal contents are one photo, named by the place of its
    first use in ``bins``.

    Nothing in the file is run, whatever it holds.
    """
    photos, same, sha256 = isolated(read_content, path)
    name_of: dict[bytes, str] = {}
    names = [name_of.setdefault(photo, f"{place:05d}") for place, photo in enumerate(photos)]
    trials = [
        Trial(names[2 * pair], names[2 * pair + 1], answer, int(fold))
        for pair, (answer, fold) in enumerate(
            zip(same, contiguous_folds(len(same)).tolist(), strict=True)
        )
    ]
    return [
        assemble(
            path.stem.lower(),
            "bin",
            trials,
            pictures={name: Photo(name, photo) for photo, name in name_of.items()},
            person=None,
            protocol_files=[(path.name, sha256)],
            aligned=True,
        )
    ]


def read_content(path: Path) -> tuple[list[bytes], list[bool], str]:
    """Return the photos, the answers and the SHA-256 of a file."""
    data = read_whole(path, most=MAX_BIN_BYTES)
    stream = io.BytesIO(data)
    try:
        content = _Unpickler(stream, encoding="bytes").load()
        if rest := len(data) - stream.tell():
            raise pickle.UnpicklingError(f"{rest} bytes follow its end")
        if not isinstance(content, tuple | list) or len(content) != 2:
            raise DatasetError(f"{path} does not hold the two parts (bins, issame_list)")
        bins, answers = (part.listed() if isinstance(part, _Array) else part for part in content)
    except (DatasetError, MemoryError):
        raise
    except pickle.UnpicklingError as error:
        raise DatasetError(f"{path} is not a readable InsightFace .bin: {error}") from None
    except Exception as error:  # a broken pickle raises whatever its instructions cause
        raise DatasetError(f"{path} is cut off or damaged ({type(error).__name__})") from None
    if not isinstance(bins, tuple | list):
        raise DatasetError(f"{path}: its first part, bins, is not a list")
    if not isinstance(answers, tuple | list):
        raise DatasetError(f"{path}: its second part, issame_list, is not a list")
    if not answers or len(bins) != 2 * len(answers):
        raise DatasetError(
            f"{path} has {len(bins)} photos and {len(answers)} answers; a pair needs two photos"
        )
    for place, answer in enumerate(answers):
        if not isinstance(answer, int | np.integer | np.bool_) or answer not in (0, 1):
            raise DatasetError(f"{path}: answer {place} is neither true nor false")
    photos = [_photo(path, place, element) for place, element in enumerate(bins)]
    return photos, [bool(answer) for answer in answers], digest_of(data)


def _photo(path: Path, place: int, element: object) -> bytes:
    if isinstance(element, _Array):
        element = element.row()
    if not isinstance(element, bytes | bytearray):
        raise DatasetError(f"{path}: photo {place} is neither bytes nor a row of uint8")
    if not element.startswith(_SIGNATURES):
        raise DatasetError(f"{path}: photo {place} is neither JPEG nor PNG")
    return bytes(element)


class _Type:
    """Stands for ``numpy.dtype``; the state that a pickle gives it is its byte order."""

    def __init__(self, code: Any, *_: object) -> None:
        self.code = code.decode() if isinstance(code, bytes) else str(code)

    def __setstate__(self, state: Any) -> None:
        if state[1] in (">", b">"):
            self.code = f">{self.code}"


class _Array:
    """Stands for an array: NumPy's own trusts the state that a pickle gives it."""

    def __init__(self, *_: object) -> None:
        self.shape: Any = (0,)
        self.values: Any = []

    def __setstate__(self, state: Any) -> None:
        _, self.shape, kind, _, content = state
        if not isinstance(self.shape, tuple) or not all(isinstance(n, int) for n in self.shape):
            raise pickle.UnpicklingError("an array has no shape")
        self.values = content if isinstance(content, list) else np.frombuffer(content, kind.code)

    def listed(self) -> list[Any] | None:
        """Return the elements of an array of one dimension."""
        return list(self.values) if len(self.shape) == 1 else None

    def row(self) -> bytes | None:
        """Return the bytes of a row, or a column, of uint8."""
        is_row = isinstance(self.values, np.ndarray) and self.values.dtype == np.uint8
        return (
            self.values.tobytes()
            if is_row and max(self.shape, default=0) == len(self.values)
            else None
        )


def _filled(raw: bytes, kind: _Type, shape: Any, _: Any) -> _Array:
    array = _Array()
    array.__setstate__((1, shape, kind, False, raw))
    return array


def _encoded(text: str | bytes = b"", _: Any = "latin-1") -> bytes:
    return text if isinstance(text, bytes) else text.encode("latin-1")


_ALLOWED: dict[str, Any] = {
    "numpy.ndarray": "ndarray",
    "numpy.dtype": _Type,
    "_codecs.encode": _encoded,
    "builtins.bytearray": _encoded,
    "__builtin__.bytearray": _encoded,
}
for _core in ("numpy.core", "numpy._core"):
    _ALLOWED |= {
        f"{_core}.multiarray._reconstruct": _Array,
        f"{_core}.multiarray.scalar": lambda kind, raw: np.frombuffer(raw, kind.code)[0],
        f"{_core}.numeric._frombuffer": _filled,
    }


class _Unpickler(pickle.Unpickler):
    """Reads plain values; what a pickle names means what stands above, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if f"{module}.{name}" not in _ALLOWED:
            wanted = f"{module}.{name}"[:100]
            raise pickle.UnpicklingError(f"it asks for {wanted!a}; nothing was run")
        return _ALLOWED[f"{module}.{name}"]


READER = Reader(
    "an InsightFace .bin file",
    lambda path: path.suffix.lower() == ".bin" and path.is_file(),
    read_bin,
)
