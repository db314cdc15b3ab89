"""A reader of pickles that holds plain values and one-dimensional arrays, and runs nothing.

Python's own unpickler resolves names and calls what they name; restricting ``find_class`` leaves
its other costs, such as a memo as large as the file asks for. This is an interpreter of its own
for the few instructions that ``pickle.dump((bins, issame_list), …)`` emits in protocols 0 to 5,
from Python 2 and 3 and NumPy 1 and 2. A name in the file only selects one of the ``_Name``
members below; nothing is imported and no object of the file is ever called.

References
----------
CPython, ``Lib/pickletools.py``: the instructions and their arguments.
NumPy, ``ndarray.__reduce__``, ``ndarray.__reduce_ex__`` and ``dtype.__reduce__``.
"""

import enum
import pickle
import re
import struct
from collections.abc import Callable

from verify.evaluation.readers.pickled_arrays import (
    DTYPES,
    PickledArray,
    PickledDtype,
    RefusedPickle,
    filled,
    listed,
    scalar,
)

MAX_STEPS = 6_000_000
"""Instructions in a file: a hundred thousand photos saved as arrays need about four million."""
MAX_PAYLOAD = 16 * 2**20
"""Bytes of one string: far above any aligned photo."""
_MAX_LINE = 256
_MAX_MEMO = 2**32

_ESCAPE = re.compile(rb"\\(x[0-9a-fA-F]{2}|[\\'\"nrt])?")
_ESCAPED = {b"\\": b"\\", b"'": b"'", b'"': b'"', b"n": b"\n", b"r": b"\r", b"t": b"\t"}


class _Name(enum.Enum):
    RECONSTRUCT = enum.auto()
    FROMBUFFER = enum.auto()
    SCALAR = enum.auto()
    NDARRAY = enum.auto()
    DTYPE = enum.auto()
    ENCODE = enum.auto()
    BYTEARRAY = enum.auto()


_NAMES = {
    ("numpy", "ndarray"): _Name.NDARRAY,
    ("numpy", "dtype"): _Name.DTYPE,
    ("_codecs", "encode"): _Name.ENCODE,
    ("__builtin__", "bytearray"): _Name.BYTEARRAY,
    ("builtins", "bytearray"): _Name.BYTEARRAY,
    # NumPy 2 moved numpy.core to numpy._core.
    **{
        (f"numpy.{core}.{module}", name): meaning
        for core in ("core", "_core")
        for module, name, meaning in (
            ("multiarray", "_reconstruct", _Name.RECONSTRUCT),
            ("multiarray", "scalar", _Name.SCALAR),
            ("numeric", "_frombuffer", _Name.FROMBUFFER),
        )
    },
}

_MARK = object()


def read_pickle(data: bytes) -> object:
    """Return what the pickle in ``data`` holds.

    Returns
    -------
    object
        None, bool, int, str, bytes, list, tuple, :class:`PickledArray` or nested ones. Byte
        strings of Python 2 are bytes.

    Raises
    ------
    RefusedPickle
        The pickle is truncated, followed by something else, or needs an instruction or a name
        that plain values do not need. Nothing was run.
    """
    return _Machine(data).run()


class _Machine:
    """Stack and memo of one reading; all work is bounded by the length of the data."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0
        self.stack: list[object] = []
        self.memo: dict[int, object] = {}
        self.encoded = 0

    def run(self) -> object:
        steps = 0
        while True:
            opcode = self.take(1)
            if opcode == pickle.STOP:
                break
            steps += 1
            if steps > MAX_STEPS:
                raise RefusedPickle(f"it has more than {MAX_STEPS} instructions")
            action = _ACTIONS.get(opcode)
            if action is None:
                raise RefusedPickle(
                    f"instruction {opcode!r} at byte {self.at - 1} is not one that plain values "
                    "need; nothing was run"
                )
            action(self)
        if self.at != len(self.data):
            raise RefusedPickle(f"{len(self.data) - self.at} bytes follow its end")
        result = self.pop()
        if self.stack:
            raise RefusedPickle("it leaves more than one value")
        return result

    # Reading

    def take(self, size: int) -> bytes:
        end = self.at + size
        if end > len(self.data):
            raise RefusedPickle(f"it ends within an instruction, at byte {len(self.data)}")
        piece = self.data[self.at : end]
        self.at = end
        return piece

    def number(self, form: str) -> int:
        return int(struct.unpack(form, self.take(struct.calcsize(form)))[0])

    def payload(self, form: str) -> bytes:
        size = self.number(form)
        if size < 0 or size > MAX_PAYLOAD:
            raise RefusedPickle(f"a string of {size} bytes is longer than {MAX_PAYLOAD}")
        return self.take(size)

    def line(self, longest: int = _MAX_LINE) -> bytes:
        end = self.data.find(b"\n", self.at, self.at + longest + 1)
        if end < 0:
            raise RefusedPickle(f"the line at byte {self.at} does not end")
        piece = self.data[self.at : end]
        self.at = end + 1
        return piece

    def decimal(self, line: bytes) -> int:
        if not re.fullmatch(rb"-?[0-9]{1,19}", line):
            raise RefusedPickle(f"there is no number before byte {self.at}")
        return int(line)

    # The stack

    def push(self, value: object) -> None:
        self.stack.append(value)

    def pop(self) -> object:
        if not self.stack or self.stack[-1] is _MARK:
            raise RefusedPickle(f"a value is missing at byte {self.at}")
        return self.stack.pop()

    def pop_to_mark(self) -> list[object]:
        for place in range(len(self.stack) - 1, -1, -1):
            if self.stack[place] is _MARK:
                values = self.stack[place + 1 :]
                del self.stack[place:]
                return values
        raise RefusedPickle(f"a mark is missing at byte {self.at}")

    def pop_tuple(self, size: int) -> None:
        values = [self.pop() for _ in range(size)]
        self.push(tuple(reversed(values)))

    def put(self, key: int) -> None:
        if not 0 <= key < _MAX_MEMO:
            raise RefusedPickle(f"memo position {key} is out of range")
        value = self.pop()
        self.memo[key] = value
        self.push(value)

    def get(self, key: int) -> None:
        if key not in self.memo:
            raise RefusedPickle(f"memo position {key} was never filled")
        self.push(self.memo[key])

    def append(self, values: list[object]) -> None:
        target = self.pop()
        if not isinstance(target, list):
            raise RefusedPickle("values are appended to what is not a list")
        target += values
        self.push(target)

    # Instructions with more than one line

    def integer(self) -> None:
        line = self.line()
        if line in (b"00", b"01"):
            self.push(line == b"01")
        else:
            self.push(self.decimal(line))

    def long_line(self) -> None:
        self.push(self.decimal(self.line().removesuffix(b"L")))

    def long_bytes(self) -> None:
        size = self.number("<B")
        if size > 8:
            raise RefusedPickle("an integer is longer than 64 bits")
        self.push(int.from_bytes(self.take(size), "little", signed=True))

    def text(self, raw: bytes, encoding: str = "utf-8") -> None:
        try:
            self.push(raw.decode(encoding))
        except UnicodeDecodeError:
            raise RefusedPickle(f"the text before byte {self.at} is not {encoding}") from None

    def quoted(self) -> None:
        """Read a byte string of protocol 0, which Python 2 writes as its repr."""
        line = self.line(4 * MAX_PAYLOAD)
        if len(line) < 2 or line[:1] not in (b"'", b'"') or line[:1] != line[-1:]:
            raise RefusedPickle(f"the string before byte {self.at} is not quoted")

        def plain(found: re.Match[bytes]) -> bytes:
            escape = found.group(1)
            if escape is None:
                raise RefusedPickle(f"the string before byte {self.at} has an unknown escape")
            return _ESCAPED.get(escape) or bytes.fromhex(escape[1:].decode("ascii"))

        self.push(_ESCAPE.sub(plain, line[1:-1]))

    def name(self, module: object, name: object) -> None:
        if not isinstance(module, str) or not isinstance(name, str):
            raise RefusedPickle("a name is not text")
        meaning = _NAMES.get((module, name))
        if meaning is None:
            shown = f"{module}.{name}"[:100].encode("ascii", "backslashreplace").decode("ascii")
            raise RefusedPickle(f"it asks for {shown}, which plain values do not need; not run")
        self.push(meaning)

    def name_of_lines(self) -> None:
        module, name = self.line(), self.line()
        self.name(module.decode("latin-1"), name.decode("latin-1"))

    def name_of_stack(self) -> None:
        name, module = self.pop(), self.pop()
        self.name(module, name)

    def reduce(self) -> None:
        arguments, name = self.pop(), self.pop()
        match name, arguments:
            case _Name.ENCODE, (str() as text, encoding) if _text(encoding) == "latin1":
                self.push(self.encode(text))
            case _Name.BYTEARRAY, (str() as text, encoding) if _text(encoding) == "latin-1":
                self.push(self.encode(text))
            case _Name.BYTEARRAY, (bytes() as raw,):
                self.push(raw)
            case _Name.BYTEARRAY, ():
                self.push(b"")
            case _Name.RECONSTRUCT, (_Name.NDARRAY, (0,), _):
                self.push(PickledArray())
            case _Name.DTYPE, (code, bool() | int(), bool() | int()):
                if not DTYPES.fullmatch(_text(code)):
                    raise RefusedPickle("an array holds other elements than integers or objects")
                self.push(PickledDtype(_text(code)))
            case _Name.FROMBUFFER, (bytes() as raw, PickledDtype() as dtype, tuple() as shape, _):
                self.push(filled(PickledArray(), shape, dtype, raw))
            case _Name.SCALAR, (PickledDtype() as dtype, bytes() as raw):
                self.push(scalar(dtype, raw))
            case _:
                raise RefusedPickle(
                    f"the value before byte {self.at} is not made as plain values and arrays are; "
                    "nothing was run"
                )

    def encode(self, text: str) -> bytes:
        # A remembered string could be encoded without end: the copies may not outgrow the file.
        self.encoded += len(text)
        if self.encoded > len(self.data):
            raise RefusedPickle("it multiplies its strings")
        try:
            return text.encode("latin-1")
        except UnicodeEncodeError:
            raise RefusedPickle("a byte string has characters above 255") from None

    def build(self) -> None:
        state, target = self.pop(), self.pop()
        match target, state:
            case PickledArray(data=None), (
                1,
                tuple() as shape,
                PickledDtype() as dtype,
                bool() | int(),
                bytes() as raw,
            ):
                filled(target, shape, dtype, raw)
            case PickledArray(data=None, items=None), (
                1,
                tuple() as shape,
                PickledDtype() as dtype,
                bool() | int(),
                list() as items,
            ):
                listed(target, shape, dtype, items)
            case PickledDtype(), (int(), order, None, None, None, -1, -1, int()):
                if _text(order) not in ("|", "<", ">", "="):
                    raise RefusedPickle("an array has no known byte order")
                target.order = _text(order)
            case _:
                raise RefusedPickle(
                    f"the state before byte {self.at} is not that of an array; nothing was run"
                )
        self.push(target)


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value[:16].decode("latin-1")
    return value if isinstance(value, str) else ""


_Action = Callable[[_Machine], None]


def _refuse_protocol(machine: _Machine) -> None:
    protocol = machine.number("<B")
    if protocol > 5:
        raise RefusedPickle(f"it is of protocol {protocol}; protocols 0 to 5 are understood")


def _skip_frame(machine: _Machine) -> None:
    # A frame only says how far to read ahead; everything lies in memory already.
    machine.number("<Q")


_ACTIONS: dict[bytes, _Action] = {
    pickle.PROTO: _refuse_protocol,
    pickle.FRAME: _skip_frame,
    pickle.MARK: lambda m: m.push(_MARK),
    pickle.NONE: lambda m: m.push(None),
    pickle.NEWTRUE: lambda m: m.push(True),
    pickle.NEWFALSE: lambda m: m.push(False),
    pickle.INT: _Machine.integer,
    pickle.BININT: lambda m: m.push(m.number("<i")),
    pickle.BININT1: lambda m: m.push(m.number("<B")),
    pickle.BININT2: lambda m: m.push(m.number("<H")),
    pickle.LONG: _Machine.long_line,
    pickle.LONG1: _Machine.long_bytes,
    pickle.STRING: _Machine.quoted,
    pickle.BINSTRING: lambda m: m.push(m.payload("<i")),
    pickle.SHORT_BINSTRING: lambda m: m.push(m.payload("<B")),
    pickle.BINBYTES: lambda m: m.push(m.payload("<I")),
    pickle.SHORT_BINBYTES: lambda m: m.push(m.payload("<B")),
    pickle.BINBYTES8: lambda m: m.push(m.payload("<Q")),
    pickle.BYTEARRAY8: lambda m: m.push(m.payload("<Q")),
    pickle.UNICODE: lambda m: m.text(m.line(2 * MAX_PAYLOAD), "raw-unicode-escape"),
    pickle.BINUNICODE: lambda m: m.text(m.payload("<I")),
    pickle.SHORT_BINUNICODE: lambda m: m.text(m.payload("<B")),
    pickle.BINUNICODE8: lambda m: m.text(m.payload("<Q")),
    pickle.EMPTY_LIST: lambda m: m.push([]),
    pickle.LIST: lambda m: m.push(m.pop_to_mark()),
    pickle.APPEND: lambda m: m.append([m.pop()]),
    pickle.APPENDS: lambda m: m.append(m.pop_to_mark()),
    pickle.EMPTY_TUPLE: lambda m: m.push(()),
    pickle.TUPLE: lambda m: m.push(tuple(m.pop_to_mark())),
    pickle.TUPLE1: lambda m: m.pop_tuple(1),
    pickle.TUPLE2: lambda m: m.pop_tuple(2),
    pickle.TUPLE3: lambda m: m.pop_tuple(3),
    pickle.PUT: lambda m: m.put(m.decimal(m.line())),
    pickle.BINPUT: lambda m: m.put(m.number("<B")),
    pickle.LONG_BINPUT: lambda m: m.put(m.number("<I")),
    pickle.MEMOIZE: lambda m: m.put(len(m.memo)),
    pickle.GET: lambda m: m.get(m.decimal(m.line())),
    pickle.BINGET: lambda m: m.get(m.number("<B")),
    pickle.LONG_BINGET: lambda m: m.get(m.number("<I")),
    pickle.GLOBAL: _Machine.name_of_lines,
    pickle.STACK_GLOBAL: _Machine.name_of_stack,
    pickle.REDUCE: _Machine.reduce,
    pickle.BUILD: _Machine.build,
}
