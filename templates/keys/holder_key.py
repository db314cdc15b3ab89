"""The text of a holder's key, as requests carry it: 32 bytes in base64url."""

import base64
import re

from templates.errors import SealError

# 32 bytes are 43 characters, of which the last has four bits: 16 of the 64 can end a key.
PATTERN = "^[A-Za-z0-9_-]{42}[AEIMQUYcgkosw048]=?$"
_KEY = re.compile(PATTERN)


def decode_holder_key(text: object) -> bytearray:
    """Return the key of a text, to be wiped after its use; an error does not repeat the text."""
    if not isinstance(text, str) or not _KEY.fullmatch(text):
        raise SealError("a holder key is 32 bytes in base64url: 43 characters, and = or nothing")
    return bytearray(base64.urlsafe_b64decode(text.rstrip("=") + "="))


def wipe(key: bytearray | None) -> None:
    """Overwrite a key. Python's own copies of its text are released, not overwritten."""
    if key is not None:
        key[:] = bytes(len(key))
