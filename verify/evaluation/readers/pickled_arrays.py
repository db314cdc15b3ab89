"""NumPy's arrays and numbers as they lie in a pickle, without NumPy."""

import math
import re
from dataclasses import dataclass
from typing import cast

DTYPES = re.compile(r"b1|[iu][1248]|O[48]")
"""Codes of the types that are read."""


class RefusedPickle(ValueError):
    """A pickle that is broken or holds anything but plain values; the message says what."""


@dataclass(eq=False)
class PickledDtype:
    """Type of array elements: ``b1``, ``u1``, ``i8`` …, and their byte order; ``O8`` is objects."""

    code: str
    order: str = "|"

    @property
    def itemsize(self) -> int:
        """Bytes of an element."""
        return int(self.code[1])

    @property
    def is_object(self) -> bool:
        """Whether elements are values of the pickle and no numbers."""
        return self.code[0] == "O"


@dataclass(eq=False, repr=False)
class PickledArray:
    """An array as it lies in the file: ``data``, or ``items`` where it is of objects.

    Both are None until its contents were seen. ``items`` is the list of the pickle, which may
    change it later: its own length counts, not the shape.
    """

    shape: tuple[int, ...] = (0,)
    dtype: PickledDtype | None = None
    data: bytes | None = None
    items: list[object] | None = None


def _sides(shape: tuple[object, ...]) -> tuple[int, ...]:
    if len(shape) > 4 or not all(type(side) is int and 0 <= side < 2**40 for side in shape):
        raise RefusedPickle("an array has no plain shape")
    return cast(tuple[int, ...], shape)


def filled(
    array: PickledArray, shape: tuple[object, ...], dtype: PickledDtype, raw: bytes
) -> PickledArray:
    """Give an array its numbers, and return it.

    Raises
    ------
    RefusedPickle
        The bytes are not those of the shape and type.
    """
    sides = _sides(shape)
    if dtype.is_object or math.prod(sides) * dtype.itemsize != len(raw):
        raise RefusedPickle(f"an array of shape {sides} is stored in {len(raw)} bytes")
    array.shape, array.dtype, array.data = sides, dtype, raw
    return array


def listed(
    array: PickledArray, shape: tuple[object, ...], dtype: PickledDtype, items: list[object]
) -> None:
    """Give an array of objects its objects.

    Raises
    ------
    RefusedPickle
        They are not as many as the shape says.
    """
    sides = _sides(shape)
    if not dtype.is_object or math.prod(sides) != len(items):
        raise RefusedPickle(f"an array of shape {sides} is stored as {len(items)} objects")
    array.shape, array.dtype, array.items = sides, dtype, items


def scalar(dtype: PickledDtype, raw: bytes) -> int | bool:
    """Return one number of a type.

    Raises
    ------
    RefusedPickle
        The bytes are not those of one number.
    """
    if dtype.is_object or len(raw) != dtype.itemsize:
        raise RefusedPickle("a number has the wrong length")
    if dtype.code == "b1":
        return raw != b"\0"
    order = "big" if dtype.order == ">" else "little"
    return int.from_bytes(raw, order, signed=dtype.code[0] == "i")  # type: ignore[arg-type]
