"""A reader of MATLAB files of version 5 to 7: cells, structs, text and numbers, nothing else.

SciPy's compiled reader trusts what a file declares: altered files crashed the process. Here every
length is checked against the bytes that are there before anything is allocated.

References
----------
MathWorks, "MAT-File Format", R2023b, chapter 1: Level 5 MAT-files.
"""

import math
import zlib
from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

MAX_UNPACKED = 64 * 2**20
"""Bytes of all unpacked variables together; AgeDB's protocol has a few million."""
_MAX_FIELDS = 64
_MAX_EMPTY = 2**15
_MAX_TEXT = 2**20

_DEEPEST = 16
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMERIC = range(6, 16)
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}

Array = NDArray[np.generic]
Order = Literal["little", "big"]


class RefusedMat(ValueError):
    """A file that is broken or of another version; the message says what."""


def read_variable(data: bytes, name: str) -> Array | None:
    """Return one variable, or None where the file has no such one.

    Returns
    -------
    array
        Cells as object arrays, structs as arrays with object fields, text as one ``str`` per
        array, numbers as they are stored; shapes as in MATLAB.

    Raises
    ------
    RefusedMat
        The file is truncated, of version 4 or 7.3, or holds what is not understood.
    """
    order: Order | None = {b"IM": "little", b"MI": "big"}.get(data[126:128])  # type: ignore[assignment]
    version = 0 if order is None else int.from_bytes(data[124:126], order)
    if data[:8] == b"\x89HDF\r\n\x1a\n" or data[:10] == b"MATLAB 7.3" or version == 0x0200:
        raise RefusedMat("it is of MATLAB 7.3; save it again with save(…, '-v7')")
    if order is None or version != 0x0100:
        raise RefusedMat("it is not a MATLAB file of version 5 to 7")
    room = MAX_UNPACKED
    for kind, body in _elements(data[128:], order, padded=False):
        if kind == _COMPRESSED:
            unpacked = _unpacked(body, most=room)
            room -= len(unpacked)
            kind, body = next(_elements(unpacked, order, padded=False), (0, b""))
        if kind == _MATRIX:
            stored_name, array = _matrix(body, order, 0, wanted=name)
            if stored_name == name:
                return array
    return None


def _unpacked(body: bytes, *, most: int) -> bytes:
    stream = zlib.decompressobj()
    try:
        # A limit of 0 would be none.
        data = stream.decompress(body, most + 1)
    except zlib.error:
        raise RefusedMat("a compressed variable is broken") from None
    if len(data) > most or not stream.eof:
        raise RefusedMat(f"a variable is cut off, or all unpack to more than {MAX_UNPACKED} bytes")
    return data


def _elements(data: bytes, order: Order, *, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """Type and content of the elements in ``data``."""
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise RefusedMat("it is truncated")
        tag = int.from_bytes(data[at : at + 4], order)
        if tag >> 16:
            # The small form: length and type share one word, the content the next.
            kind, size, start, end = tag & 0xFFFF, tag >> 16, at + 4, at + 8
            if size > 4:
                raise RefusedMat("a small element is longer than four bytes")
        else:
            kind, size = tag, int.from_bytes(data[at + 4 : at + 8], order)
            start = at + 8
            end = start + size + (-size % 8 if padded else 0)
        if start + size > len(data):
            raise RefusedMat("it is truncated")
        yield kind, data[start : start + size]
        at = end


def _matrix(body: bytes, order: Order, depth: int, *, wanted: str = "") -> tuple[str, Array]:
    if not body:
        return "", _EMPTY
    if depth > _DEEPEST:
        raise RefusedMat(f"it nests more than {_DEEPEST} levels")
    parts = _elements(body, order)
    take = _taker(parts)
    flags, sides = _numbers(*take(), order), _numbers(*take(), order)
    name = take()[1].decode("latin-1")
    if flags.size < 1 or not 2 <= sides.size <= 4 or {flags.dtype.kind, sides.dtype.kind} - {*"iu"}:
        raise RefusedMat("a variable has no plain header")
    if depth == 0 and name != wanted:
        return name, _EMPTY
    shape = tuple(int(side) for side in sides)
    count = math.prod(shape)
    kind = int(flags[0]) & 0xFF
    # Even an empty cell takes eight bytes, a number at least one. No side may be absurd beside a
    # side of 0 either.
    least = 8 if kind == _CELL else 1
    if min(shape) < 0 or count * least > len(body) or max(shape) > max(len(body), _MAX_EMPTY):
        raise RefusedMat("a variable declares more elements than it holds")
    if kind == _CELL:
        return name, _filled(np.empty(count, object), shape, lambda: _inner(take, order, depth))
    if kind == _STRUCT:
        return name, _struct(take, order, depth, shape, len(body))
    if kind == _CHAR:
        return name, np.array([_text(*take(), order)])
    if kind in _NUMERIC:
        values = _numbers(*take(), order)
        if values.size != count:
            raise RefusedMat("an array does not fill its shape")
        return name, values.reshape(shape, order="F")
    raise RefusedMat(f"it holds an array of class {kind}, which is not understood")


_Take = Callable[[], tuple[int, bytes]]


def _taker(parts: Iterator[tuple[int, bytes]]) -> _Take:
    def take() -> tuple[int, bytes]:
        try:
            return next(parts)
        except StopIteration:
            raise RefusedMat("a variable is truncated") from None

    return take


def _inner(take: _Take, order: Order, depth: int) -> Array:
    kind, body = take()
    if kind != _MATRIX:
        raise RefusedMat("a cell or field holds no array")
    return _matrix(body, order, depth + 1)[1]


def _filled(target: Array, shape: tuple[int, ...], make: Callable[[], object]) -> Array:
    for place in range(target.size):
        target[place] = make()  # type: ignore[assignment]
    return target.reshape(shape, order="F")


def _struct(take: _Take, order: Order, depth: int, shape: tuple[int, ...], limit: int) -> Array:
    lengths = _numbers(*take(), order)
    raw = take()[1]
    length = int(lengths[0]) if lengths.size == 1 and lengths.dtype.kind in "iu" else 0
    if not 0 < length <= 64 or len(raw) % length:
        raise RefusedMat("a struct has no plain field names")
    if len(raw) > _MAX_FIELDS * length:
        raise RefusedMat(f"a struct has more than {_MAX_FIELDS} fields")
    fields = [
        raw[at : at + length].split(b"\0")[0].decode("latin-1") for at in range(0, len(raw), length)
    ]
    if not fields or "" in fields or len(set(fields)) < len(fields):
        raise RefusedMat("a struct has no plain field names")
    count = math.prod(shape)
    if count * len(fields) * 8 > limit:
        raise RefusedMat("a struct declares more elements than it holds")
    return _filled(
        np.empty(count, [(field, object) for field in fields]),
        shape,
        lambda: tuple(_inner(take, order, depth) for _ in fields),
    )


def _numbers(kind: int, body: bytes, order: Order) -> Array:
    code = _NUMBERS.get(kind)
    if code is None or len(body) % int(code[1]):
        raise RefusedMat("numbers are of no known type")
    return np.frombuffer(body, ("<" if order == "little" else ">") + code)


def _text(kind: int, body: bytes, order: Order) -> str:
    encoding = _TEXTS.get(kind)
    if encoding is None:
        raise RefusedMat("text is of no known encoding")
    if len(body) > _MAX_TEXT:
        raise RefusedMat(f"text is longer than {_MAX_TEXT} bytes")
    if encoding in ("utf-16", "utf-32"):
        encoding += "-le" if order == "little" else "-be"
    try:
        return body.decode(encoding)
    except UnicodeDecodeError:
        raise RefusedMat("text is not in its encoding") from None


_EMPTY: Array = np.empty((0, 0))
