"""The texts that calls are made with, and the key that probes are signed with under each of them.

An API key is ``vf_<prefix>_<secret>``. A subject token, which the service gives out for one call
of one subject, is ``vft_<prefix of its API key>_<sealed, base64url>``.
"""

import re

from templates.errors import StoreError
from templates.keys.sealing import derive_key

TOKEN = re.compile(r"vf_([0-9a-f]{12})_([0-9a-f]{64})")
SUBJECT_TOKEN = re.compile(r"vft_([0-9a-f]{12})_([A-Za-z0-9_-]{128,768})")


def is_token(text: str) -> bool:
    """Tell whether a text has the format of an API key; no database is asked."""
    return TOKEN.fullmatch(text) is not None


def probe_key(token: str) -> bytes:
    """Derive the 32-byte key that a client signs its probes with from what it calls with.

    Parameters
    ----------
    token
        An API key, or a subject token. Of an API key its secret is what is derived from. All of
        a subject token is: its sealed part looks random to whoever lacks the master key.

    Raises
    ------
    StoreError
        If the text is neither.
    """
    if SUBJECT_TOKEN.fullmatch(token) is not None:
        return derive_key(token.encode("ascii"), "probe-key")
    match = TOKEN.fullmatch(token)
    if match is None:
        raise StoreError("this is not an API token: one looks like vf_<prefix>_<secret>")
    return derive_key(bytes.fromhex(match[2]), "probe-key")
