"""Reading and writing the files of decoy sources."""

import os
from pathlib import Path

from templates.errors import DecoyError
from templates.keys.private_file import read_at_most, replace_private


def write_private(path: Path, data: bytes) -> None:
    """Replace `path` at once by a file of mode 0600; see `replace_private`.

    Raises
    ------
    DecoyError
        The file cannot be written.
    """
    try:
        replace_private(path, data)
    except OSError as error:
        raise DecoyError(f"cannot write {path.name}: {error.strerror}") from error


def read_bounded(path: Path, limit: int) -> bytes:
    """Read a file of at most `limit` bytes.

    Raises
    ------
    DecoyError
        The file cannot be read or is larger.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size > limit:
                raise DecoyError(f"{path.name} has {size} bytes; at most {limit} are accepted")
            data = read_at_most(file, limit)
    except OSError as error:
        raise DecoyError(f"cannot read {path.name}: {error.strerror}") from error
    if len(data) > limit:
        raise DecoyError(f"{path.name} is larger than {limit} bytes")
    return data
