"""A search for leaked biometric numbers in raw bytes.

Given vectors (embeddings, decoys, model inputs) and byte strings (photo files, pixels, tokens),
:class:`LeakSearch` finds any run of them in a blob:

- numbers as float16, float32 or float64, little-endian, at any byte position;
- numbers as decimal text of three digits after the point or more (JSON, CSV, a printed array);
- byte strings as they are;
- all of that inside base64 (either alphabet, any alignment) and hexadecimal (either case).

Runs are looked up by four consecutive numbers (or eight bytes), at every byte position of the
blob; a hit is then compared number by number with the vector, before and behind it too, until seven
agree. Four alone are met by chance: a border of a picture is in many files. The comparison has a
tolerance, because a server that embeds a photo again may differ in the last bits. It finds no run
shorter than seven numbers, nothing that was compressed or encrypted, and no sum of a vector with
something else.
"""

import base64
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

RUN = 4  # numbers in a window
STRIDE = 4  # between two windows of a vector: every run of LEAST numbers holds one
LEAST = RUN + STRIDE - 1
BYTES = 16  # bytes of a byte string that must agree
BYTE_STRIDE = 16
TEXT_RUN = 6
RELATIVE = 1e-3  # float16 rounds by at most 2⁻¹¹

_HASH = np.uint64(0x9E3779B97F4A7C15)
_TABLE_BITS = 22
_MOST_AS_TEXT = 4096  # numbers of a vector: nobody prints a picture as decimals
_FLOATS = {"float16": 2, "float32": 4, "float64": 8}
_NUMBER = re.compile(rb"\.(\d{3,20})(?:[eE]([-+]?\d{1,3}))?")
_BEFORE = re.compile(rb"-?\d{0,3}$")
_BASE64 = re.compile(rb"[A-Za-z0-9+/_-]{24,}")
_HEX = re.compile(rb"[0-9a-fA-F]{32,}")
_URL_ALPHABET = bytes.maketrans(b"-_", b"+/")


@dataclass(frozen=True)
class Leak:
    """Where what was found."""

    what: str
    form: str
    offset: int


class LeakSearch:
    """Knows what must not be found.

    Parameters
    ----------
    vectors
        Arrays by name, any shape; each is searched as the flat run of its numbers, and negated.
    strings
        Byte strings by name, 16 bytes or more.
    """

    def __init__(
        self,
        *,
        vectors: Mapping[str, ArrayLike] | None = None,
        strings: Mapping[str, bytes] | None = None,
    ) -> None:
        self._names: list[str] = []
        flat: list[NDArray[np.float64]] = []
        for name, values in (vectors or {}).items():
            for sign, label in ((1.0, name), (-1.0, f"{name}, negated")):
                self._names.append(label)
                flat.append(sign * np.asarray(values, dtype=np.float64).ravel())
        self._flat = flat
        self._windows, self._window_owner, self._window_start = _windows_of(flat, RUN, STRIDE)
        self._tables = {
            name: _Table(_keys_of(_top_halves(self._windows, name))) for name in _FLOATS
        }
        short = [vector if len(vector) <= _MOST_AS_TEXT else vector[:0] for vector in flat]
        text_windows, self._text_owner, _ = _windows_of(short, TEXT_RUN, 3, spread=0.02)
        self._text = KDTree(text_windows) if len(text_windows) else None
        self._string_names = list(strings or {})
        self._chunks, self._chunk_owner = _chunks_of(list((strings or {}).values()))
        self._strings = _Table(self._chunks[:, :8].copy().view("<u8")[:, 0])

    def find(self, blob: bytes) -> list[Leak]:
        """Everything leaks in a blob, the first of each thing and form."""
        leaks: dict[tuple[str, str], Leak] = {}
        for form, content in [("", blob), *_decoded(blob)]:
            for leak in self._find_plain(content):
                named = Leak(leak.what, f"{form}{leak.form}", leak.offset)
                leaks.setdefault((named.what, named.form), named)
        return list(leaks.values())

    def _find_plain(self, blob: bytes) -> Iterator[Leak]:
        raw = np.frombuffer(blob, dtype=np.uint8)
        if len(raw) >= BYTES:
            yield from self._find_strings(raw)
        halves = raw[:-1].astype(np.uint64) | raw[1:].astype(np.uint64) << np.uint64(8)
        for name, size in _FLOATS.items():
            if len(raw) >= RUN * size:
                yield from self._find_floats(raw, halves, name)
        yield from self._find_text(blob)

    def _find_strings(self, raw: NDArray[np.uint8]) -> Iterator[Leak]:
        count = len(raw) - BYTES + 1
        keys = np.zeros(count, dtype=np.uint64)
        for byte in range(8):
            keys |= raw[byte : byte + count].astype(np.uint64) << np.uint64(8 * byte)
        for offset, row in self._strings.hits(keys):
            if raw[offset : offset + BYTES].tobytes() == self._chunks[row].tobytes():
                yield Leak(self._string_names[self._chunk_owner[row]], "bytes", offset)

    def _find_floats(
        self, raw: NDArray[np.uint8], halves: NDArray[np.uint64], name: str
    ) -> Iterator[Leak]:
        size = _FLOATS[name]
        # The upper two bytes of a number stand last.
        skip = size - 2
        count = len(raw) - RUN * size + 1
        keys = np.zeros(count, dtype=np.uint64)
        for place in range(RUN):
            start = skip + place * size
            keys |= halves[start : start + count] << np.uint64(16 * place)
        for offset, row in self._tables[name].hits(keys):
            owner, start = self._window_owner[row], self._window_start[row]
            before = min(LEAST - RUN, start, offset // size)
            data = raw[offset - before * size : offset + LEAST * size]
            data = data[: len(data) // size * size]
            wanted = self._flat[owner][start - before : start + LEAST]
            count = min(len(data) // size, len(wanted))
            numbers = _numbers(data[: count * size].tobytes(), name)
            agree = np.isclose(numbers, wanted[:count], rtol=RELATIVE, atol=1e-7)
            if _longest_run(agree) >= min(LEAST, len(self._flat[owner])):
                yield Leak(self._names[owner], name, offset)

    def _find_text(self, blob: bytes) -> Iterator[Leak]:
        if self._text is None:
            return
        for offsets, numbers in _decimal_runs(blob):
            if len(numbers) < TEXT_RUN:
                continue
            rows = np.lib.stride_tricks.sliding_window_view(np.array(numbers), TEXT_RUN)
            matches = self._text.query(rows, p=np.inf, distance_upper_bound=6e-4)
            distances, nearest = np.asarray(matches[0]), np.asarray(matches[1])
            for at in np.flatnonzero(np.isfinite(distances)):
                yield Leak(self._names[self._text_owner[nearest[at]]], "decimals", offsets[at])


def _longest_run(agree: NDArray[np.bool_]) -> int:
    ends = np.flatnonzero(np.diff(np.concatenate([[False], agree, [False]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


class _Table:
    """Rows by 64-bit key; a bitmap decides most look-ups."""

    def __init__(self, keys: NDArray[np.uint64]) -> None:
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]
        self._seen = np.zeros(1 << _TABLE_BITS, dtype=bool)
        self._seen[_slot(keys)] = True

    def hits(self, keys: NDArray[np.uint64]) -> Iterator[tuple[int, int]]:
        """Positions in `keys` and the rows that have the key there."""
        candidates = np.flatnonzero(self._seen[_slot(keys)])
        wanted = keys[candidates]
        low = np.searchsorted(self._keys, wanted, side="left")
        high = np.searchsorted(self._keys, wanted, side="right")
        for at in np.flatnonzero(high > low):
            for row in self._order[low[at] : high[at]]:
                yield int(candidates[at]), int(row)


def _slot(keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    return ((keys * _HASH) >> np.uint64(64 - _TABLE_BITS)).astype(np.int64)


def _windows_of(
    vectors: Sequence[NDArray[np.float64]], run: int, stride: int, *, spread: float = 1e-3
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Windows of all vectors, the vector each is of, and its place in it.

    Flat ones (a black border) say nothing.
    """
    parts, owners = [np.empty((0, run))], [np.empty(0, dtype=np.int64)]
    starts = [np.empty(0, dtype=np.int64)]
    for owner, vector in enumerate(vectors):
        if len(vector) < run:
            continue
        rows = np.lib.stride_tricks.sliding_window_view(vector, run)[::stride]
        varied = rows.max(axis=1) - rows.min(axis=1) > spread
        kept = np.flatnonzero(varied & (np.abs(rows).min(axis=1) > 1e-6))
        parts.append(rows[kept])
        owners.append(np.full(len(kept), owner, dtype=np.int64))
        starts.append(kept * stride)
    windows = np.ascontiguousarray(np.concatenate(parts))
    return windows, np.concatenate(owners), np.concatenate(starts)


def _chunks_of(strings: Sequence[bytes]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Pieces of all byte strings with at least six different bytes in the first eight."""
    parts = [np.empty((0, BYTES), dtype=np.uint8)]
    owners = [np.empty(0, dtype=np.int64)]
    for owner, string in enumerate(strings):
        raw = np.frombuffer(string, dtype=np.uint8)
        if len(raw) < BYTES:
            raise ValueError(f"a byte string to search for has {BYTES} bytes or more")
        rows = np.lib.stride_tricks.sliding_window_view(raw, BYTES)[::BYTE_STRIDE]
        ordered = np.sort(rows[:, :8], axis=1)
        rows = rows[(np.diff(ordered, axis=1) != 0).sum(axis=1) >= 5]
        parts.append(rows)
        owners.append(np.full(len(rows), owner, dtype=np.int64))
    return np.ascontiguousarray(np.concatenate(parts)), np.concatenate(owners)


def as_bytes(values: ArrayLike, name: str) -> bytes:
    """Numbers as they would stand in a file, for `name` float16, float32 or float64."""
    return np.asarray(values, dtype=np.dtype(name).newbyteorder("<")).tobytes()


def _numbers(data: bytes, name: str) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):
        return np.frombuffer(data, dtype=np.dtype(name).newbyteorder("<")).astype(np.float64)


def _top_halves(windows: NDArray[np.float64], name: str) -> NDArray[np.uint64]:
    """Sign, exponent and first bits of the mantissa: 16 bits a number, blind to the last bits."""
    size = _FLOATS[name]
    stored = np.frombuffer(as_bytes(windows.ravel(), name), dtype=np.uint8)
    tops = stored.reshape(-1, size)[:, size - 2 :].astype(np.uint64)
    return (tops[:, 0] | tops[:, 1] << np.uint64(8)).reshape(-1, RUN)


def _keys_of(halves: NDArray[np.uint64]) -> NDArray[np.uint64]:
    keys = np.zeros(len(halves), dtype=np.uint64)
    for place in range(RUN):
        keys |= halves[:, place] << np.uint64(16 * place)
    return keys


def _decimal_runs(blob: bytes) -> Iterator[tuple[list[int], list[float]]]:
    """Decimal numbers that follow each other closely, with the offset of each."""
    offsets: list[int] = []
    numbers: list[float] = []
    end = 0
    for match in _NUMBER.finditer(blob):
        before = _BEFORE.search(blob, max(0, match.start() - 4), match.start())
        text = (before.group() if before else b"") + match.group()
        if numbers and match.start() - end > 24:
            yield offsets, numbers
            offsets, numbers = [], []
        offsets.append(match.start())
        numbers.append(float(text))
        end = match.end()
    yield offsets, numbers


def _decoded(blob: bytes) -> Iterable[tuple[str, bytes]]:
    """What base64 and hexadecimal text in a blob stands for, at each alignment."""
    runs = [match.group().translate(_URL_ALPHABET) for match in _BASE64.finditer(blob)]
    for phase in range(4):
        parts = []
        for run in runs:
            aligned = run[phase:]
            parts.append(base64.b64decode(aligned[: len(aligned) // 4 * 4]))
        yield f"base64 at {phase}: ", b"\0".join(parts)
    hexes = [match.group() for match in _HEX.finditer(blob)]
    for phase in range(2):
        parts = [
            bytes.fromhex(run[phase : phase + (len(run) - phase) // 2 * 2].decode())
            for run in hexes
        ]
        yield f"hexadecimal at {phase}: ", b"\0".join(parts)
