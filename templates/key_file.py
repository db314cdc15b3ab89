"""The file of master keys: which keys are good, and reading and writing them in one piece."""

import base64
import binascii
import itertools
import os
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path

from templates.errors import SealError

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


def stamp_of(status: os.stat_result) -> Stamp:
    """What changes when the file does."""
    return status.st_ino, status.st_mtime_ns, status.st_size


def read_key_file(path: Path) -> tuple[list[bytes], Stamp]:
    """Read and check the keys of a private file; :class:`SealError` says what is wrong."""
    source = f"the key file {path}"
    try:
        # Not blocking: a named pipe in the place of the file would hold the start for ever.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise SealError(f"{source} does not exist: make it with `veilface keys master`") from None
    except OSError as error:
        raise SealError(f"{source} cannot be opened: {error.strerror}") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise SealError(f"{source} is not a regular file")
        if status.st_mode & 0o077:
            raise SealError(
                f"{source} may be read by others (mode {stat.S_IMODE(status.st_mode):04o}): "
                "`chmod 600` it, and replace the keys if others could have read them"
            )
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
    keys = parse_keys((line.strip() for line in text.splitlines() if line.strip()), source=source)
    check_keys(keys, source=source)
    return keys, stamp_of(status)


def write_key_file(path: Path, keys: Sequence[bytes], *, replace: bool) -> None:
    """Write beside the place, then link or rename into it: nobody ever sees half a file."""
    text = b"".join(base64.b64encode(key) + b"\n" for key in keys)
    draft = path.with_name(f".{path.name}.{os.urandom(8).hex()}")
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            if replace:
                draft.replace(path)
            else:
                path.hardlink_to(draft)
        finally:
            draft.unlink(missing_ok=True)
        directory = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
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
