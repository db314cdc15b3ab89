"""Inputs that were findings once, made anew; each must now be read or refused within the limits."""

import json
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence

from tests.fuzz.mutations import CAP

ROOM = 10 * 2**20 - 20_000
"""Bytes that fit into the largest picture beside the picture itself."""


def pictures() -> Sequence[Callable[[], bytes]]:
    """Heads whose parts took seconds to minutes, or much memory, to be read one by one."""
    from tests.fuzz.pictures import Pictures, chunk, riff, segment

    sound = Pictures().sound
    jpeg, png = sound["JPEG"][0], sound["PNG"][0]

    def in_jpeg(unit: bytes) -> Callable[[], bytes]:
        return lambda: jpeg[:2] + unit * (ROOM // len(unit)) + jpeg[2:]

    def in_png(unit: bytes) -> Callable[[], bytes]:
        at = png.index(b"IDAT") - 4
        return lambda: png[:at] + unit * (ROOM // len(unit)) + png[at:]

    sides = struct.pack("<I", 12_999 | 12_999 << 14)
    return [
        in_jpeg(b"\xff"),  # bytes that fill up to a marker
        in_jpeg(b"\xff\0"),
        in_jpeg(segment(0xFE, b"")),
        in_jpeg(segment(0xE1, b"Exif\0\0" + bytes(10))),  # was joined piece by piece
        in_jpeg(segment(0xE1, b"Exif\0\0" + bytes(100))),
        in_jpeg(segment(0xE2, b"ICC_PROFILE\0\1\1")),
        in_png(chunk(b"abCd", b"")),
        in_png(chunk(b"IDAT", b"")),
        in_png(chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(10**6)))),  # unpacked every time
        lambda: riff([(b"VP8L", b"\x2f" + sides + bytes(30))]),
    ]


def templates() -> Sequence[Callable[[], bytes]]:
    """A signalling NaN, of which NumPy warned when it was cast."""
    from templates.contract import wire
    from tests.fuzz.tensors import CONTRACT, container, subspace, taken_apart

    header, payload = taken_apart(
        wire.encode(subspace(16, 3), contract_id=CONTRACT, dtype="float32")
    )
    broken = struct.pack("<I", 0x7F800001) + payload[4:]
    text = json.dumps(header, separators=(",", ":")).encode()
    return [lambda: container(text + b" " * (-len(text) % 8), broken)]


def bodies() -> Sequence[Callable[[], bytes]]:
    """4 MiB of JSON that took 120 MiB when it was parsed."""
    units: Mapping[str, bytes] = {"objects": b'{"":0},', "lists": b"[],", "numbers": b"1.5,"}
    return [
        lambda unit=unit: b"application/json\n[" + unit * (4 * CAP // len(unit) - 2) + b"0]"  # type: ignore[misc]
        for unit in units.values()
    ]
