"""The file of master keys: which keys are good, and reading and writing them in one piece."""

import base64
import binascii
import itertools
import os
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path

from templates.errors import SealError
from templates.keys.private_file import (
    create_private,
    read_private,
    refuse_another_users,
    replace_private,
)

KEY_BYTES = 32

_MAX_FILE_BYTES = 64 * 1024
_MIN_DISTINCT_BYTES = 16  # 32 random bytes have fewer with a probability of about 1e-15

Stamp = tuple[int, int, int]


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


def check_place(path: Path) -> int:
    """Return the mode of a key file's folder.

    Raises
    ------
    SealError
        If others may put another file there, or this is root and the place another user's.
    """
    source, folder = f"the key file {path}", path.resolve().parent
    try:
        refuse_another_users(path)
    except PermissionError as error:
        raise SealError(f"{source} cannot be used: {error.strerror}") from None
    mode = folder.stat().st_mode if folder.exists() else 0o700
    # The sticky bit, as of /tmp, is enough: it leaves renaming and removing to the owner.
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        raise SealError(
            f"the folder {folder} of the key file may be written to by others (mode "
            f"{stat.S_IMODE(mode):04o}), who could put another file there: `chmod o-w` it, "
            "and look whether the key file is still yours"
        )
    return mode


def read_key_file(path: Path) -> tuple[list[bytes], Stamp]:
    """Read and check the keys of a private file; :class:`SealError` says what is wrong."""
    source = f"the key file {path}"
    if not path.exists():
        raise SealError(f"{source} does not exist: make it with `veilface keys master`")
    mode = check_place(path)
    # systemd may hand a credential to a service as root's file that the service's user reads by an
    # access control list; its mode then shows the right to read as the group's.
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    is_credential = (
        credentials is not None
        and path.resolve().parent == Path(credentials).resolve()
        and not mode & 0o022
    )
    stamp = stamp_of(path.stat())
    data = read_private(
        path,
        _MAX_FILE_BYTES,
        source=source,
        remedy="`chmod 600` it, and replace the keys if others could have read them",
        allowed=0o040 if is_credential else 0,
    )
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError:
        raise SealError(f"{source} is not text: it holds one base64 key on each line") from None
    return keys_in(text, source=source), stamp


def write_key_file(path: Path, keys: Sequence[bytes], *, replace: bool) -> None:
    """Write a key file in one piece: nobody ever sees half of it.

    Raises
    ------
    SealError
        If the file cannot be written, is another user's, or, with `replace` false, exists already.
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
