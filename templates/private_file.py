"""Writing a file that only its owner may read, so that a crash leaves the old one or the new."""

import errno
import os
import pwd
import stat
import tempfile
from pathlib import Path

_MAX_LINKS = 40  # as the kernel's own limit


def replace_private(path: Path, data: bytes) -> None:
    """Replace ``path`` at once by a file of mode 0600 that holds ``data``.

    The bytes are written beside the target and flushed to disk before the name changes, and the
    folder is flushed after. A link stays a link, and the file keeps its owner, so that a command
    which root runs does not take a file away from the service. Both only where
    :func:`is_trusted` holds: what a stranger put in the place is replaced by a file of our own.

    Raises
    ------
    OSError
        The file cannot be written, or cannot be left to its owner; nothing is left beside the
        target.
    """
    target = follow_links(path)
    owner = _owner_to_keep(target)
    descriptor, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if owner is not None:
                _give_to(file.fileno(), owner, path)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(target.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def is_trusted(owner: int, folder: Path) -> bool:
    """Whether what a user put into a folder is what the folder's owner, root or we want there."""
    return owner in (os.geteuid(), 0) or owner == folder.stat().st_uid


def follow_links(path: Path) -> Path:
    """Return the file that a path leads to; a link that a stranger made is not followed."""
    for _ in range(_MAX_LINKS):
        try:
            status = path.lstat()
        except FileNotFoundError:
            return path
        if not stat.S_ISLNK(status.st_mode) or not is_trusted(status.st_uid, path.parent):
            return path
        path = path.parent / path.readlink()
    return path


def user_name(number: int) -> str:
    """Name a user for an error text, by the number where there is no name."""
    try:
        return f"{pwd.getpwuid(number).pw_name} ({number})"
    except KeyError:
        return str(number)


def _owner_to_keep(target: Path) -> os.stat_result | None:
    try:
        status = target.lstat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(status.st_mode) or not is_trusted(status.st_uid, target.parent):
        return None
    return status


def _give_to(descriptor: int, owner: os.stat_result, path: Path) -> None:
    if os.fstat(descriptor).st_uid == owner.st_uid:
        return
    try:
        os.fchown(descriptor, owner.st_uid, owner.st_gid)
    except OSError:
        raise PermissionError(
            errno.EPERM,
            f"it belongs to user {user_name(owner.st_uid)} and could not stay theirs: "
            "run this as that user, or as root",
            str(path),
        ) from None
