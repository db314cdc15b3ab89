"""Picture files, sound and hostile."""

import io
import struct
import zlib

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from models.decoding import decode_image
from models.errors import ImageError


def encode(image: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def picture(height: int = 40, width: int = 60) -> NDArray[np.uint8]:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 4, y * 5, (x + y) * 2], axis=-1).astype(np.uint8)


def chunk(kind: bytes, content: bytes) -> bytes:
    checksum = struct.pack(">I", zlib.crc32(kind + content))
    return struct.pack(">I", len(content)) + kind + content + checksum


def png(width: int, height: int, *, depth: int = 8, pixels: bytes = b"") -> bytes:
    """A PNG file of a size and content that need not agree."""
    head = struct.pack(">IIBBBBB", width, height, depth, 2, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(pixels or bytes(1000))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def with_chunk(data: bytes, extra: bytes, *, before: bytes) -> bytes:
    at = data.index(before) - 4
    return data[:at] + extra + data[at:]


def segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 255, marker, len(content) + 2) + content


def behind_start(jpeg: bytes, extra: bytes) -> bytes:
    return jpeg[:2] + extra + jpeg[2:]


def in_scans(count: int, *, size: tuple[int, int] = (64, 64), between: bytes = b"") -> bytes:
    """A progressive JPEG whose last scan is repeated; ``between`` stands before each repetition."""
    data = encode(Image.new("RGB", size, (120, 90, 60)), "JPEG", progressive=True)
    start = data.rindex(b"\xff\xc4", 0, data.rindex(b"\xff\xda"))
    repeated = between + data[start:-2]
    return data[:-2] + repeated * (count - data.count(b"\xff\xda")) + b"\xff\xd9"


def oriented(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


def refusal(data: bytes) -> ImageError:
    """The error that refuses a file; its message is a sentence, and quotes no cause."""
    with pytest.raises(ImageError) as caught:
        decode_image(data)
    assert str(caught.value).endswith(".")
    assert caught.value.__cause__ is None
    return caught.value
