"""Changes to any bytes: flips, cuts, splices, numbers that lie, parts that are said many times."""

import random
import re
from collections.abc import Callable, Sequence

CAP = 2**20
"""Bytes of an ordinary case. A few are larger, up to what the reader accepts."""

NUMBERS = (0, 1, 2, 3, 7, 8, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000,
           2**24 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**63,
           2**64 - 1)  # fmt: skip
LITERALS = (b"0", b"-1", b"1e999", b"-1e999", b"NaN", b"Infinity", b"-Infinity", b"1e-999", b"true",
            b"null", b"[]", b"{}", b'""', b"9007199254740993", b"18446744073709551616", b"1.0",
            b"0.5", b"9" * 400, b"9" * 5000, b'"\\ud800"', b'"\\u0000"', b"[[[[[[[[[]]]]]]]]]",
            b"-0", b"1e5", b"4096", b"128", b"65536", b"16", b"2")  # fmt: skip

_DECIMAL = re.compile(rb"-?[0-9]+(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")

Change = Callable[[random.Random, bytes, Sequence[bytes]], bytes]


def some(rng: random.Random, most: int) -> int:
    """A number from 1 to ``most``, small ones more often."""
    return min(most, 1 + int(rng.expovariate(0.7)))


def span(rng: random.Random, data: bytes) -> slice:
    """A part of ``data``, short ones more often."""
    start = rng.randint(0, len(data))
    length = rng.choice((1, 2, 4, 8, 16, 64, 256, 4096, len(data)))
    return slice(start, min(len(data), start + rng.randint(0, length)))


def flip_bits(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    broken = bytearray(data)
    for _ in range(some(rng, 16) if broken else 0):
        broken[rng.randrange(len(broken))] ^= 1 << rng.randrange(8)
    return bytes(broken)


def set_bytes(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    broken = bytearray(data)
    for _ in range(some(rng, 16) if broken else 0):
        broken[rng.randrange(len(broken))] = rng.choice(
            (0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256))
        )
    return bytes(broken)


def cut(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    return data[: rng.randint(0, len(data))]


def remove(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    part = span(rng, data)
    return data[: part.start] + data[part.stop :]


def repeat(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    part = span(rng, data)
    times: int = min(rng.choice((2, 3, 10, 100, 1000)), 1 + CAP // max(1, part.stop - part.start))
    return data[: part.start] + data[part] * times + data[part.stop :]


def insert_noise(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + rng.randbytes(rng.choice((1, 2, 4, 16, 300))) + data[at:]


def overwrite(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    part = span(rng, data)
    return data[: part.start] + rng.randbytes(part.stop - part.start) + data[part.stop :]


def set_number(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    size = rng.choice((1, 2, 3, 4, 8))
    if len(data) < size:
        return data
    at = rng.randint(0, min(len(data) - size, rng.choice((16, 64, 1024, len(data)))))
    value: int = (rng.choice(NUMBERS) + rng.choice((-1, 0, 0, 1))) % 256**size
    return data[:at] + value.to_bytes(size, rng.choice(("little", "big"))) + data[at + size :]


def set_decimal(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Another number, or something else, in the place of one that is written in digits."""
    numbers = list(_DECIMAL.finditer(data[:CAP]))
    if not numbers:
        return data
    one = rng.choice(numbers)
    value = rng.choice((rng.choice(LITERALS), str(rng.choice(NUMBERS)).encode()))
    return data[: one.start()] + value + data[one.end() :]


def splice(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    return data[: rng.randint(0, len(data))] + other[rng.randint(0, len(other)) :]


def transplant(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    at = rng.randint(0, len(data))
    return data[:at] + other[span(rng, other)] + data[at:]


CHANGES: Sequence[Change] = (
    flip_bits, set_bytes, cut, remove, repeat, insert_noise, overwrite, set_number, set_number,
    set_decimal, splice, transplant,
)  # fmt: skip


def mutated(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Change ``data`` one to six times."""
    for _ in range(some(rng, 6)):
        change = rng.choice(CHANGES)
        data = bytes(change(rng, data, others)[:CAP])
    return data
