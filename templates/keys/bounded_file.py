"""Reading a file whose size is not trusted, at a cost that follows the file and not the limit."""

import os
import stat
from pathlib import Path
from typing import BinaryIO

from templates.errors import SealError

_PIECE = 2**20


def read_at_most(file: BinaryIO, most: int) -> bytes:
    """Read a file, and stop one byte beyond ``most``.

    ``file.read(most + 1)`` asks for all that memory even where the file is small: a limit of
    gigabytes then fails under a limit of the process's address space.

    Returns
    -------
    bytes
        More than ``most`` bytes, by one, where the file is larger than that.

    Raises
    ------
    OSError
        The file cannot be read.
    """
    data = file.read(min(os.fstat(file.fileno()).st_size, most) + 1)
    pieces, size = [data], len(data)
    # A pipe states no size, and a file may grow while it is read.
    while size <= most and (piece := file.read(min(_PIECE, most + 1 - size))):
        pieces.append(piece)
        size += len(piece)
    return data if len(pieces) == 1 else b"".join(pieces)


def read_private(path: Path, most: int, *, source: str, remedy: str) -> bytes:
    """Read a small file that nobody else may read, and stop one byte beyond ``most``.

    Parameters
    ----------
    source, remedy
        What messages call the file, and what to do where others may read it.

    Raises
    ------
    SealError
        If the file cannot be read, or others may read it.
    """
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            data = read_at_most(file, most)
    except OSError as error:
        raise SealError(f"{source} cannot be read: {error.strerror}") from None
    if mode & 0o077:
        raise SealError(f"{source} may be read by others (mode {stat.S_IMODE(mode):04o}): {remedy}")
    return data
