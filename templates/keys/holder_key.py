"""The text of a holder's key, as requests and files carry it: 32 bytes in base64url."""

import base64
import os
import re
from pathlib import Path

from templates.errors import SealError
from templates.keys.private_file import create_private, read_private
from templates.keys.randomness import KEY_BYTES

# 32 bytes are 43 characters, of which the last has four bits: 16 of the 64 can end a key.
PATTERN = "^[A-Za-z0-9_-]{42}[AEIMQUYcgkosw048]=?$"
_KEY = re.compile(PATTERN)
_MAX_FILE_BYTES = 64


def new_holder_key() -> bytearray:
    """Draw a key."""
    return bytearray(os.urandom(KEY_BYTES))


def encode_holder_key(key: bytes | bytearray) -> str:
    """Return the text of a key, without padding."""
    return base64.urlsafe_b64encode(key).decode("ascii").rstrip("=")


def decode_holder_key(text: object) -> bytearray:
    """Return the key of a text, to be wiped after its use; an error does not repeat the text."""
    if not isinstance(text, str) or not _KEY.fullmatch(text):
        raise SealError("a holder key is 32 bytes in base64url: 43 characters, and = or nothing")
    return bytearray(base64.urlsafe_b64decode(text.rstrip("=") + "="))


def read_holder_key(path: Path) -> bytearray:
    """Read a key from a private file that holds nothing else but the end of the line."""
    source = f"the holder key file {path}"
    data = read_private(
        path,
        _MAX_FILE_BYTES,
        source=source,
        remedy="`chmod 600` it, and enroll again with another key if others could have read this "
        "one",
    )
    try:
        return decode_holder_key(data.decode("ascii").removesuffix("\n"))
    except (SealError, UnicodeDecodeError):
        raise SealError(
            f"{source} holds no key: one is 43 characters of base64url on one line"
        ) from None


def write_holder_key(path: Path, key: bytes | bytearray) -> None:
    """Write a key into a new file of mode 0600; :class:`SealError` if there is one already."""
    try:
        create_private(path, f"{encode_holder_key(key)}\n".encode())
    except FileExistsError:
        raise SealError(
            f"the holder key file {path} exists already and is not overwritten"
        ) from None
    except OSError as error:
        raise SealError(f"the holder key file {path} cannot be written: {error.strerror}") from None


def wipe(key: bytearray | None) -> None:
    """Overwrite a key. Python's own copies of its text are released, not overwritten."""
    if key is not None:
        key[:] = bytes(len(key))
