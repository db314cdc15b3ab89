"""Reading and writing files in one piece: private ones with mode 0600.

A crash leaves the old file or the new one. Root does not write over what another user owns: the
service could not read it afterwards, and a user could have chosen the place.
"""

import errno
import os
import secrets
from pathlib import Path
from typing import BinaryIO

_PIECE = 2**20


def replace_private(path: Path, data: bytes) -> None:
    """Replace ``path`` at once by a file of mode 0600 that holds ``data``.

    The bytes are written beside the target and flushed to disk before the name changes, and the
    folder is flushed after; folders that are missing are made. A link stays a link.

    Raises
    ------
    OSError
        The file cannot be written, or is another user's. Nothing is left beside the target.
    """
    _write(path, Path(os.path.realpath(path)), data, mode=0o600, new=False)


def replace_public(path: Path, data: bytes) -> None:
    """Replace a file as :func:`replace_private` does; the umask says who may read it."""
    _write(path, Path(os.path.realpath(path)), data, mode=0o666, new=False)


def create_private(path: Path, data: bytes) -> None:
    """Write a new file of mode 0600; ``FileExistsError`` where there is a file or a link."""
    _write(path, path.parent.resolve() / path.name, data, mode=0o600, new=True)


def refuse_another_users(path: Path) -> None:
    """Refuse to work as root on a file or a link, or in a folder, that another user owns."""
    if os.geteuid() == 0:
        existing = next(place for place in (path, *path.parents) if os.path.lexists(place))
        if owner := existing.lstat().st_uid:
            raise PermissionError(
                errno.EPERM, f"{existing} belongs to user {owner}: run this as that user"
            )


def read_at_most(file: BinaryIO, most: int) -> bytes:
    """Read a file, and stop one byte beyond ``most``.

    ``file.read(most + 1)`` asks for all that memory even where the file is small: a limit of
    gigabytes then fails under a limit of the process's address space.
    """
    pieces = [file.read(min(os.fstat(file.fileno()).st_size, most) + 1)]
    size = len(pieces[0])
    # A pipe states no size, and a file may grow while it is read.
    while size <= most and (piece := file.read(min(_PIECE, most + 1 - size))):
        pieces.append(piece)
        size += len(piece)
    return b"".join(pieces)


def read_bounded(path: Path, most: int) -> bytes:
    """Read a file of at most ``most`` bytes; an ``OSError`` says that it has more."""
    with path.open("rb") as file:
        data = read_at_most(file, most)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has more than {most} bytes", str(path))
    return data


def _write(path: Path, target: Path, data: bytes, *, mode: int, new: bool) -> None:
    """Write a draft beside the target, flush it, and put it in its place."""
    try:
        if target.exists() and not target.is_file():
            raise OSError(errno.EINVAL, "it is there and no regular file: name another one")
        for each in (path, target, path.parent, target.parent):  # a link of theirs leads anywhere
            refuse_another_users(each)
        target.parent.mkdir(mode=0o700 if mode == 0o600 else 0o777, parents=True, exist_ok=True)
        draft = target.parent / f".{target.name}.{secrets.token_hex(4)}"
        # So that the kernel applies the umask; to read it, one has to set it for all threads.
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(descriptor)
            if new:
                path.hardlink_to(draft)
            else:
                draft.replace(target)
        finally:
            draft.unlink(missing_ok=True)
        folder = os.open(target.parent, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
