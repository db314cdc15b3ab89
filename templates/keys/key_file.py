"""The file of master keys: which keys are good, and reading and writing them in one piece."""

import base64
import binascii
import os
import stat
from collections.abc import Sequence
from pathlib import Path

from templates.errors import SealError
from templates.keys.private_file import (
    create_private,
    read_at_most,
    refuse_another_users,
    replace_private,
)

KEY_BYTES = 32

_MAX_FILE_BYTES = 64 * 1024

Stamp = tuple[int, int, int]


def check_keys(keys: Sequence[bytes], *, source: str) -> None:
    """Raise :class:`SealError` for no key, a repeated one, or one of another length."""
    if not keys:
        raise SealError(f"{source} holds no key")
    for number, key in enumerate(keys, start=1):
        if len(key) != KEY_BYTES:
            raise SealError(
                f"key {number} of {source} has {len(key)} bytes, not {KEY_BYTES}: "
                "restore it from a copy"
            )
    if len(set(keys)) != len(keys):
        raise SealError(f"{source} holds the same key twice")


def keys_in(text: str, *, source: str) -> list[bytes]:
    """Read and check the keys of a text: one base64 key on a line, empty lines between."""
    keys = []
    for number, line in enumerate(filter(None, map(str.strip, text.splitlines())), start=1):
        try:
            keys.append(base64.b64decode(line, validate=True))
        except (binascii.Error, ValueError):
            raise SealError(f"key {number} of {source} is not base64") from None
    check_keys(keys, source=source)
    return keys


def stamp_of(status: os.stat_result) -> Stamp:
    """What changes when the file does."""
    return status.st_ino, status.st_mtime_ns, status.st_size


def read_key_file(path: Path) -> tuple[list[bytes], Stamp]:
    """Read and check the keys of a private file; :class:`SealError` says what is wrong."""
    source, folder = f"the key file {path}", path.resolve().parent
    if not path.exists():
        raise SealError(
            f"{source} does not exist: restore it from a copy; the first `veilface setup`, "
            "`veilface calibrate` or `veilface serve` makes one for an empty database, and "
            "`openssl rand -base64 32` one for exports"
        )
    try:
        refuse_another_users(path)
    except PermissionError as error:
        raise SealError(f"{source} cannot be used: {error.strerror}") from None
    # systemd may hand a credential to a service as root's file that the service's user reads by an
    # access control list; its mode then shows the right to read as the group's.
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    is_credential = (
        credentials is not None
        and folder == Path(credentials).resolve()
        and not folder.stat().st_mode & 0o022
    )
    stamp = stamp_of(path.stat())
    data = _read_private(path, source, allowed=0o040 if is_credential else 0)
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError:
        raise SealError(f"{source} is not text: it holds one base64 key on each line") from None
    return keys_in(text, source=source), stamp


def _read_private(path: Path, source: str, *, allowed: int) -> bytes:
    """Read a file that nobody else may read, but for the `allowed` bits of the mode."""
    try:
        # Not blocking: a named pipe in the place of the file would hold the reader for ever.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            os.close(descriptor)
            raise SealError(f"{source} is not a regular file")
        with os.fdopen(descriptor, "rb") as file:
            data = read_at_most(file, _MAX_FILE_BYTES)
    except OSError as error:
        raise SealError(f"{source} cannot be read: {error.strerror}") from None
    if mode & 0o077 & ~allowed:
        raise SealError(
            f"{source} may be read by others (mode {stat.S_IMODE(mode):04o}): `chmod 600` it, and "
            "replace the keys if others could have read them"
        )
    if len(data) > _MAX_FILE_BYTES:
        raise SealError(f"{source} has more than {_MAX_FILE_BYTES} bytes")
    return data


def write_key_file(path: Path, keys: Sequence[bytes], *, replace: bool) -> None:
    """Write a key file in one piece; :class:`SealError` where it cannot be, or may not replace."""
    text = b"".join(base64.b64encode(key) + b"\n" for key in keys)
    try:
        (replace_private if replace else create_private)(path, text)
    except FileExistsError:
        raise SealError(f"the key file {path} exists already and is not overwritten") from None
    except OSError as error:
        raise SealError(f"the key file {path} cannot be written: {error.strerror}") from None
