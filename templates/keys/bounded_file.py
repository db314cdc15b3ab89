"""Reading a file whose size is not trusted, at a cost that follows the file and not the limit."""

import os
from typing import BinaryIO

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
