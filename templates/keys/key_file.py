"""The file of master keys: which keys are good, and reading and writing them in one piece."""

import base64
import binascii
import contextlib
import fcntl
import itertools
import os
import stat
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from templates.errors import SealError
from templates.keys.private_file import (
    create_private,
    follow_links,
    is_trusted,
    replace_private,
    user_name,
)

KEY_BYTES = 32

_MAX_FILE_BYTES = 64 * 1024
_MIN_DISTINCT_BYTES = 16  # 32 random bytes have fewer with a probability of about 1e-15

Stamp = tuple[int, int, int]

_held = threading.local()


def check_keys(keys: Sequence[bytes], *, source: str) -> None:
    """Raise :class:`SealError` for no key, a repeated one, or one that nobody drew at random."""
    if not keys:
        raise SealError(f"{source} holds no key")
    for number, key in enumerate(keys, start=1):
        if fault := _weakness(key):
            raise SealError(f"key {number} of {source} {fault}")
    if len(set(keys)) != len(keys):
        raise SealError(f"{source} holds the same key twice")


def parse_keys(encoded: Iterable[str], *, source: str) -> list[bytes]:
    """Decode base64 keys; :class:`SealError` names the one that is not."""
    keys = []
    for number, line in enumerate(encoded, start=1):
        try:
            keys.append(base64.b64decode(line, validate=True))
        except (binascii.Error, ValueError):
            raise SealError(f"key {number} of {source} is not base64") from None
    return keys


def keys_in(text: str, *, source: str) -> list[bytes]:
    """Read and check the keys of a text: one base64 key on a line, empty lines between."""
    lines = (line.strip() for line in text.splitlines())
    keys = parse_keys((line for line in lines if line), source=source)
    check_keys(keys, source=source)
    return keys


def stamp_of(status: os.stat_result) -> Stamp:
    """What changes when the file does."""
    return status.st_ino, status.st_mtime_ns, status.st_size


def read_key_file(path: Path) -> tuple[list[bytes], Stamp]:
    """Read and check the keys of a private file; :class:`SealError` says what is wrong."""
    source = f"the key file {path}"
    check_folder(path)
    try:
        target = _own_target(path, source=source)
        # Not blocking: a named pipe in the place of the file would hold the start for ever.
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
        descriptor = os.open(target, flags)
    except FileNotFoundError:
        raise SealError(f"{source} does not exist: make it with `veilface keys master`") from None
    except OSError as error:
        raise SealError(f"{source} cannot be opened: {error.strerror}") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise SealError(f"{source} is not a regular file")
        if status.st_mode & _forbidden(status, target.parent):
            raise SealError(
                f"{source} may be read by others (mode {stat.S_IMODE(status.st_mode):04o}): "
                "`chmod 600` it, and replace the keys if others could have read them"
            )
        _check_owner(status, target.parent, source=source)
        if status.st_size > _MAX_FILE_BYTES:
            raise SealError(f"{source} has {status.st_size} bytes, more than {_MAX_FILE_BYTES}")
        data = os.read(descriptor, _MAX_FILE_BYTES)
    except OSError as error:
        raise SealError(f"{source} cannot be read: {error.strerror}") from None
    finally:
        os.close(descriptor)
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError:
        raise SealError(f"{source} is not text: it holds one base64 key on each line") from None
    return keys_in(text, source=source), stamp_of(status)


def _forbidden(status: os.stat_result, folder: Path) -> int:
    """Bits of the mode that a key file must not have.

    systemd may hand a credential to a service as root's file that the service's user reads by an
    access control list; its mode then shows the right to read as the group's.
    """
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    is_credential = (
        credentials is not None
        and folder == Path(credentials).resolve()
        and status.st_uid == 0
        and not folder.stat().st_mode & 0o022
    )
    return 0o037 if is_credential else 0o077


def check_folder(path: Path) -> None:
    """Refuse a place where another user of the host can put a file of theirs instead.

    The sticky bit, as of ``/tmp``, is enough: it leaves renaming and removing to the owner.

    Raises
    ------
    SealError
        If others may write to the folder of the file, or to the one that a link leads to.
    """
    for folder in {path.absolute().parent, path.resolve().parent}:
        try:
            mode = folder.stat().st_mode
        except OSError:
            continue  # opening the file says what is wrong
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            raise SealError(
                f"the folder {folder} of the key file may be written to by others (mode "
                f"{stat.S_IMODE(mode):04o}), who could put another file there: `chmod o-w` it, "
                "and look whether the key file is still yours"
            )


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Let nobody else change the keys of a file meanwhile; a thread may take it again inside.

    The lock is on a file beside the key file, which stays, and which the system lets go when the
    process ends. It is not waited for: a rotation may take long, and who asks for two at once
    should know.

    Raises
    ------
    SealError
        If another process or thread changes them at this moment, or the lock cannot be taken.
    """
    check_folder(path)
    try:
        target = _own_target(path, source=f"the key file {path}").resolve()
    except OSError as error:
        raise SealError(f"the key file {path} cannot be locked: {error.strerror}") from None
    locked_here: set[Path] = _held.__dict__.setdefault("targets", set())
    if target in locked_here:
        yield
        return
    descriptor = _open_lock(path, target)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SealError(
                f"another rotation of the key file {path} runs: wait until it is done"
            ) from None
        except OSError as error:
            raise SealError(f"the key file {path} cannot be locked: {error.strerror}") from None
        locked_here.add(target)
        try:
            yield
        finally:
            locked_here.discard(target)
    finally:
        os.close(descriptor)


def write_key_file(path: Path, keys: Sequence[bytes], *, replace: bool) -> None:
    """Write beside the place, then link or rename into it: nobody ever sees half a file.

    A replaced file keeps its owner, and a link to it stays a link.

    Raises
    ------
    SealError
        If the file cannot be written, could not stay its owner's, or, with `replace` false,
        exists already.
    """
    text = b"".join(base64.b64encode(key) + b"\n" for key in keys)
    try:
        if replace:
            replace_private(path, text)
        else:
            create_private(path, text)
    except FileExistsError:
        raise SealError(f"the key file {path} exists already and is not overwritten") from None
    except OSError as error:
        raise SealError(f"the key file {path} cannot be written: {error.strerror}") from None


def _own_target(path: Path, *, source: str) -> Path:
    target = follow_links(path)
    if target.is_symlink():
        _check_owner(target.lstat(), target.parent, source=f"a link on the way to {source}")
    return target


def _check_owner(status: os.stat_result, folder: Path, *, source: str) -> None:
    if not is_trusted(status.st_uid, folder.stat().st_uid):
        raise SealError(
            f"{source} belongs to user {user_name(status.st_uid)}, who is neither the user of "
            "this program, nor root, nor the owner of its folder: find out who put it there, "
            "and `chown` it where it is yours"
        )


def _open_lock(path: Path, target: Path) -> int:
    """Open the file of the lock; who makes it leaves it to the owner of the key file."""
    lock = target.with_name(f".{target.name}.lock")
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        owner = target.stat()
    except FileNotFoundError:
        raise SealError(
            f"the key file {path} does not exist: make it with `veilface keys master`"
        ) from None
    except OSError as error:
        raise SealError(f"the key file {path} cannot be locked: {error.strerror}") from None
    try:
        try:
            descriptor = os.open(lock, flags | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            # Never given away: it may be a hard link to a file that somebody wants to have.
            return os.open(lock, flags)
        if os.fstat(descriptor).st_uid != owner.st_uid:
            with contextlib.suppress(PermissionError):
                os.fchown(descriptor, owner.st_uid, owner.st_gid)
        return descriptor
    except OSError as error:
        raise SealError(
            f"the file {lock}, which locks the key file, cannot be opened: {error.strerror}; "
            f"run this as user {user_name(owner.st_uid)}, or as root"
        ) from None


def _weakness(key: bytes) -> str | None:
    """Say what is wrong with a key, for keys that nobody drew at random."""
    advice = "make one with `veilface keys master`"
    if len(key) != KEY_BYTES:
        return f"has {len(key)} bytes, not {KEY_BYTES}: {advice}"
    steps = {(b - a) % 256 for a, b in itertools.pairwise(key)}
    if len(set(key)) < _MIN_DISTINCT_BYTES or len(steps) == 1 or key[:16] == key[16:]:
        return f"is a pattern, not random bytes: {advice}"
    if all(0x20 <= byte < 0x7F for byte in key):
        return f"is readable text, not random bytes: {advice}"
    return None
