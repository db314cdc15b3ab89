"""Pickles of plain values and of NumPy's arrays, of which no code is run."""

import io
import pickle
import re
from typing import Any

import numpy as np

_TYPE = re.compile(r"b1|[iu][1248]|O[48]")


class RefusedPickle(ValueError):
    """A pickle that is broken, or asks for what plain values do not need."""


class PickledType:
    """Type of the elements of an array, such as ``<i8``."""

    def __init__(self, code: Any, *_: object) -> None:
        self.code = _text(code)
        self.order = "|"
        if not _TYPE.fullmatch(self.code):
            raise RefusedPickle("an array holds other elements than integers or objects")

    def __setstate__(self, state: Any) -> None:
        self.order = _text(state[1])

    def numbers(self, raw: bytes) -> list[Any]:
        """Return the numbers of which these are the bytes."""
        try:
            values: list[Any] = np.frombuffer(raw, self.order + self.code).tolist()
        except (TypeError, ValueError):
            raise RefusedPickle("numbers are not stored as their type says") from None
        return values


class PickledArray:
    """An array as it lies in the pickle: its shape, and its bytes or its objects."""

    def __init__(self) -> None:
        self.shape: tuple[int, ...] = (0,)
        self.type = PickledType("u1")
        self.content: bytes | list[Any] = b""

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, _, content = state
        if (
            not isinstance(kind, PickledType)
            or not isinstance(content, bytes | bytearray | list)
            or not all(isinstance(side, int) for side in shape)
        ):
            raise RefusedPickle("an array is not stored as NumPy stores it")
        self.shape, self.type = tuple(shape), kind
        self.content = bytes(content) if isinstance(content, bytearray) else content


def _text(value: Any) -> str:
    """Return text, which is bytes where Python 2 wrote it."""
    return str(value, "latin-1") if isinstance(value, bytes) else str(value)


def _encoded(text: str | bytes = b"", encoding: Any = "latin-1") -> bytes:
    if _text(encoding) not in ("latin1", "latin-1"):
        raise RefusedPickle("a byte string has another encoding than latin-1")
    return text if isinstance(text, bytes) else text.encode("latin-1")


def _empty_array(*_: object) -> PickledArray:
    return PickledArray()


def _filled_array(raw: bytes, kind: PickledType, shape: tuple[int, ...], _: str) -> PickledArray:
    array = PickledArray()
    array.__setstate__((1, shape, kind, False, raw))
    return array


def _number(kind: PickledType, raw: bytes) -> Any:
    (number,) = kind.numbers(raw)
    return number


# What a pickle may name, and what that means here: nothing of NumPy itself, whose arrays and types
# trust the state that a pickle gives them.
_ALLOWED = {
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): PickledType,
    ("_codecs", "encode"): _encoded,
    ("builtins", "bytearray"): _encoded,
    ("__builtin__", "bytearray"): _encoded,
    **{
        (f"numpy.{core}.{module}", name): meaning
        for core in ("core", "_core")
        for module, name, meaning in (
            ("multiarray", "_reconstruct", _empty_array),
            ("multiarray", "scalar", _number),
            ("numeric", "_frombuffer", _filled_array),
        )
    },
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise RefusedPickle(f"it asks for {f'{module}.{name}'[:100]!a}; nothing was run")
        return _ALLOWED[module, name]


def read_pickle(data: bytes) -> object:
    """Return the plain values that a pickle holds; arrays are :class:`PickledArray`.

    It may take much memory: call it in a process of its own (``isolated``).

    Raises
    ------
    RefusedPickle
        It is broken, is followed by something, or names what is not allowed. Nothing of it was run.
    """
    stream = io.BytesIO(data)
    try:
        value = _Unpickler(stream, encoding="bytes").load()
    except (RefusedPickle, MemoryError):
        raise
    except Exception as error:  # a broken pickle raises whatever its instructions cause
        raise RefusedPickle(f"it is cut off or damaged ({type(error).__name__})") from None
    if rest := len(data) - stream.tell():
        raise RefusedPickle(f"{rest} bytes follow its end")
    return value
