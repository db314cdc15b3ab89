"""ONNX files, read and written without the ``onnx`` package: protobuf's wire format.

Only fields that Veilface looks at have a name here; the numbers are those of ``onnx.proto``.
"""

from collections.abc import Iterator
from enum import IntEnum


class Model(IntEnum):
    """Fields of a file."""

    IR_VERSION = 1
    PRODUCER_NAME = 2
    PRODUCER_VERSION = 3
    DOC_STRING = 6
    GRAPH = 7
    OPSET_IMPORT = 8
    METADATA_PROPS = 14
    FUNCTIONS = 25


class Graph(IntEnum):
    """Fields of a graph; a function shares ``NODE`` under a number of its own."""

    NODE = 1
    NAME = 2
    INITIALIZER = 5
    INPUT = 11
    OUTPUT = 12
    SPARSE_INITIALIZER = 15


class Node(IntEnum):
    """Fields of a node."""

    INPUT = 1
    OUTPUT = 2
    OP_TYPE = 4
    ATTRIBUTE = 5


class Attribute(IntEnum):
    """Fields of a node's attribute."""

    NAME = 1
    INT = 3
    TENSOR = 5
    GRAPH = 6
    INTS = 8
    TENSORS = 10
    GRAPHS = 11
    TYPE = 20


class Tensor(IntEnum):
    """Fields of a tensor."""

    DIMS = 1
    DATA_TYPE = 2
    NAME = 8
    RAW_DATA = 9
    DATA_LOCATION = 14


FUNCTION_NODE = 7
FLOAT, INT8 = 1, 3  # types of a tensor's elements
EXTERNAL = 1  # location of a tensor's data


class Message:
    """The fields of one message, by number; what is nested is parsed when it is asked for.

    Raises
    ------
    ValueError
        The bytes are no message.
    """

    def __init__(self, data: bytes | memoryview) -> None:
        self._values: dict[int, list[int | memoryview]] = {}
        for number, value in _fields(memoryview(data)):
            self._values.setdefault(number, []).append(value)

    def number(self, field: int) -> int | None:
        """Return a whole number, or None."""
        values = self._values.get(field, [None])
        if isinstance(values[-1], memoryview):
            raise ValueError("bytes where a number is expected")
        return values[-1]

    def messages(self, *fields: int) -> list["Message"]:
        """Return what is nested in a field, or in a field of what is nested, and so on."""
        messages = [self]
        for field in fields:
            messages = [Message(part) for message in messages for part in message._parts(field)]
        return messages

    def text(self, field: int) -> str:
        """Return a string; empty where there is none."""
        return "".join(str(part, "utf-8") for part in self._parts(field)[-1:])

    def _parts(self, field: int) -> list[memoryview]:
        values = self._values.get(field, [])
        parts = [value for value in values if isinstance(value, memoryview)]
        if len(parts) < len(values):
            raise ValueError("a number where bytes are expected")
        return parts


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == 0:
            value, at = _varint(data, at)
            yield tag >> 3, value - 2**64 if value >> 63 else value
            continue
        if kind == 2:
            size, at = _varint(data, at)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise ValueError("an unknown wire type")
        if size > len(data) - at:
            raise ValueError("cut short")
        yield tag >> 3, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 70:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value & (2**64 - 1), at
    raise ValueError("a number without an end")


def message(*fields: tuple[int, int | str | bytes]) -> bytes:
    """Write a message: numbers from 0 on, strings, and bytes or messages; by field number."""
    written = b""
    for number, value in sorted(fields, key=lambda field: field[0]):
        if isinstance(value, int):
            written += _written(number << 3) + _written(value)
        else:
            data = value.encode() if isinstance(value, str) else value
            written += _written(number << 3 | 2) + _written(len(data)) + data
    return written


def _written(value: int) -> bytes:
    low = bytearray()
    while value > 127:
        low.append(value & 127 | 128)
        value >>= 7
    return bytes([*low, value])
