"""The text of an API key, and the key that its holder signs probes with."""

import re

from templates.errors import StoreError
from templates.keys.sealing import derive_key

TOKEN = re.compile(r"vf_([0-9a-f]{12})_([0-9a-f]{64})")


def is_token(text: str) -> bool:
    """Tell whether a text has the format of a token; no database is asked."""
    return TOKEN.fullmatch(text) is not None


def probe_key(token: str) -> bytes:
    """Derive the 32-byte key that a client signs its probes with from its API token.

    Raises
    ------
    StoreError
        If the text is not a token.
    """
    match = TOKEN.fullmatch(token)
    if match is None:
        raise StoreError("this is not an API token: one looks like vf_<prefix>_<secret>")
    return derive_key(bytes.fromhex(match[2]), "probe-key")
