"""Writing a file in one piece, and never where somebody else's link leads.

A command that root runs often writes into a folder of the service's user. Who owns a folder can put
a link in the place of the file, or of a folder above it, and would have root write where that user
may not. So the folders on the way are opened one by one, and only links that root or we made are
followed. A crash leaves the old file or the new.
"""

import errno
import os
import pwd
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_MAX_LINKS = 40  # as the kernel's own limit
# Not to be listed but to be passed through, where the system knows the difference.
_FOLDER = os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY)


def replace_private(path: Path, data: bytes) -> None:
    """Replace ``path`` at once by a file of mode 0600 that holds ``data``.

    The bytes are written beside the target and flushed to disk before the name changes, and the
    folder is flushed after; folders that are missing are made. A link of root's or ours stays a
    link, and the file keeps its owner where :func:`is_trusted` holds, so that a command which root
    runs does not take a file away from the service. A file that a stranger put in the place is
    replaced by one of our own.

    Raises
    ------
    OSError
        The file cannot be written or cannot be left to its owner; what is there is no regular
        file; or a link of somebody else is on the way to it. Nothing is left beside the target.
    """
    _replace(path, data, mode=0o600)


def replace_public(path: Path, data: bytes) -> None:
    """Replace a file as :func:`replace_private` does; the umask says who may read it."""
    _replace(path, data, mode=0o666)


def create_private(path: Path, data: bytes) -> None:
    """Write a new file of mode 0600; folders that are missing are made with mode 0700.

    Raises
    ------
    FileExistsError
        There is a file, or a link, already.
    OSError
        The file cannot be written, or a link of somebody else is on the way to it.
    """
    with _errors_name(path), _folder_of(path, mode=0o700) as (folder, name):
        draft = _write_draft(name, data, folder=folder, mode=0o600, owner=None)
        try:
            os.link(draft, name, src_dir_fd=folder, dst_dir_fd=folder, follow_symlinks=False)
        finally:
            os.unlink(draft, dir_fd=folder)
        _flush(folder)


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, where they are missing.

    Raises
    ------
    OSError
        It cannot be made, or a link of somebody else is on the way to it.
    """
    with _errors_name(path):
        os.close(_entered(path))


def is_trusted(owner: int, folder_owner: int) -> bool:
    """Whether what a user put into a folder is what the folder's owner, root or we want there."""
    return owner in (os.geteuid(), 0, folder_owner)


def follow_links(path: Path) -> Path:
    """Return the file to read that a path leads to; a link of a stranger is not followed."""
    for _ in range(_MAX_LINKS):
        try:
            status = path.lstat()
        except FileNotFoundError:
            return path
        if not stat.S_ISLNK(status.st_mode):
            return path
        if not is_trusted(status.st_uid, path.parent.stat().st_uid):
            return path
        path = path.parent / path.readlink()
    return path


def user_name(number: int) -> str:
    """Name a user for an error text, by the number where there is no name."""
    try:
        return f"{pwd.getpwuid(number).pw_name} ({number})"
    except KeyError:
        return str(number)


def _replace(path: Path, data: bytes, *, mode: int) -> None:
    with _errors_name(path), _folder_of(path, follow=True) as (folder, name):
        owner = _owner_to_keep(name, folder)
        draft = _write_draft(name, data, folder=folder, mode=mode, owner=owner)
        try:
            os.replace(draft, name, src_dir_fd=folder, dst_dir_fd=folder)
        except BaseException:
            os.unlink(draft, dir_fd=folder)
            raise
        _flush(folder)


@contextmanager
def _errors_name(path: Path) -> Iterator[None]:
    """Put the whole path into an error, in place of the part of it that was looked at."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


@contextmanager
def _folder_of(path: Path, *, mode: int = 0o777, follow: bool = False) -> Iterator[tuple[int, str]]:
    """Open the folder of a file for the block; with ``follow``, of what a link there leads to."""
    folder, name = _entered(path.parent, mode=mode), path.name
    try:
        for _ in range(_MAX_LINKS):
            target = _linked(name, folder) if follow else None
            if target is None:
                break
            further = _entered(target.parent, start=folder)
            os.close(folder)
            folder, name = further, target.name
        yield folder, name
    finally:
        os.close(folder)


def _entered(
    path: Path, *, start: int | None = None, mode: int = 0o777, links: int = _MAX_LINKS
) -> int:
    """Open a folder part by part, make what is missing, and return its descriptor."""
    if links == 0:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    folder = os.open(path.anchor or ".", _FOLDER, dir_fd=start)
    try:
        for name in path.relative_to(path.anchor).parts:
            target = _linked(name, folder)
            if target is None:
                if _status(name, folder) is None:
                    with suppress(FileExistsError):
                        os.mkdir(name, mode, dir_fd=folder)
                further = os.open(name, _FOLDER, dir_fd=folder)
            else:
                further = _entered(target, start=folder, mode=mode, links=links - 1)
            os.close(folder)
            folder = further
    except BaseException:
        os.close(folder)
        raise
    return folder


def _linked(name: str, folder: int) -> Path | None:
    """Return where a link leads; None for what is no link.

    Raises
    ------
    PermissionError
        The link is neither root's nor ours, or changes while it is read.
    """
    status = _status(name, folder)
    if status is None or not stat.S_ISLNK(status.st_mode):
        return None
    if status.st_uid not in (os.geteuid(), 0):
        raise PermissionError(
            errno.EPERM,
            f"there is a link of user {user_name(status.st_uid)} on the way, which is not "
            "followed: name another place, or run this as that user",
        )
    target = os.readlink(name, dir_fd=folder)
    again = _status(name, folder)
    if again is None or (again.st_ino, again.st_ctime_ns) != (status.st_ino, status.st_ctime_ns):
        raise PermissionError(errno.EPERM, "a link on the way was changed while it was followed")
    return Path(target)


def _status(name: str, folder: int) -> os.stat_result | None:
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return None


def _owner_to_keep(name: str, folder: int) -> os.stat_result | None:
    status = _status(name or ".", folder)
    if status is None:
        return None
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is there and no regular file: name another one")
    return status if is_trusted(status.st_uid, os.fstat(folder).st_uid) else None


def _write_draft(
    name: str, data: bytes, *, folder: int, mode: int, owner: os.stat_result | None
) -> str:
    """Write the bytes to a file beside the target, flush it to disk, and return its name."""
    draft = f".{name}.{os.urandom(8).hex()}"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(draft, flags, mode, dir_fd=folder)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if owner is not None:
                _give_to(file.fileno(), owner)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        os.unlink(draft, dir_fd=folder)
        raise
    return draft


def _flush(folder: int) -> None:
    descriptor = os.open(".", os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _give_to(descriptor: int, owner: os.stat_result) -> None:
    if os.fstat(descriptor).st_uid == owner.st_uid:
        return
    try:
        os.fchown(descriptor, owner.st_uid, owner.st_gid)
    except OSError:
        raise PermissionError(
            errno.EPERM,
            f"it belongs to user {user_name(owner.st_uid)} and could not stay theirs: "
            "run this as that user, or as root",
        ) from None
