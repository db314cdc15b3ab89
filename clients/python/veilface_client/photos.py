"""Photos as callers have them, read into memory once so that they can be sent again."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

Photo = bytes | bytearray | memoryview | str | os.PathLike[str] | BinaryIO
"""The bytes of a picture file, its path, or a file that is open for reading in binary mode."""


def read_photos(photos: Photo | Iterable[Photo]) -> list[bytes]:
    """Return the bytes of one photo, or of several.

    Raises
    ------
    ValueError
        There is no photo, or one is empty.
    TypeError
        One is none of bytes, path and binary file.
    """
    one = isinstance(photos, bytes | bytearray | memoryview | str | os.PathLike)
    if one or hasattr(photos, "read") or not isinstance(photos, Iterable):
        return [_read(photos)]
    contents = [_read(photo) for photo in photos]
    if not contents:
        raise ValueError("there is no photo: at least one is needed")
    return contents


def _read(photo: object) -> bytes:
    data = photo
    if isinstance(photo, bytearray | memoryview):
        data = bytes(photo)
    elif isinstance(photo, str | os.PathLike):
        data = Path(photo).read_bytes()
    elif hasattr(photo, "read"):
        data = photo.read()
    if not isinstance(data, bytes):
        raise TypeError(f"a photo is bytes, a path or a binary file, not {type(data).__name__}")
    if not data:
        raise ValueError("a photo is empty")
    return data
