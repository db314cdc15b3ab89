"""Photos as callers have them, read into memory once so that they can be sent again."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO, cast

Photo = bytes | bytearray | memoryview | str | os.PathLike[str] | BinaryIO
"""The bytes of a picture file, its path, or a file that is open for reading in binary mode."""

MAX_PHOTO_BYTES = 64 * 2**20
"""The most that is read of one photo; services take less."""


def read_photo(photo: Photo) -> bytes:
    """Return the bytes of a photo.

    Raises
    ------
    ValueError
        It is empty, or larger than :data:`MAX_PHOTO_BYTES`.
    TypeError
        It is none of bytes, path and binary file.
    """
    data: object
    if isinstance(photo, bytes | bytearray | memoryview):
        data = bytes(photo)
    elif isinstance(photo, str | os.PathLike):
        with Path(photo).open("rb") as file:
            data = file.read(MAX_PHOTO_BYTES + 1)
    elif callable(getattr(photo, "read", None)):
        data = photo.read(MAX_PHOTO_BYTES + 1)
    else:
        data = photo
    if not isinstance(data, bytes):
        raise TypeError(f"a photo is bytes, a path or a binary file, not {type(data).__name__}")
    if not 0 < len(data) <= MAX_PHOTO_BYTES:
        raise ValueError(f"a photo has 1 to {MAX_PHOTO_BYTES} bytes, not {len(data)}")
    return data


def read_photos(photos: Photo | Iterable[Photo]) -> list[bytes]:
    """Return the bytes of one photo, or of several."""
    if isinstance(photos, bytes | bytearray | memoryview | str | os.PathLike):
        return [read_photo(photos)]
    if hasattr(photos, "read") or not isinstance(photos, Iterable):
        return [read_photo(cast("BinaryIO", photos))]
    contents = [read_photo(photo) for photo in photos]
    if not contents:
        raise ValueError("there is no photo: at least one is needed")
    return contents
