"""The texts that calls are made with.

An API key is ``vf_<prefix>_<secret>``. A subject token, which the service gives out for one call
of one subject, is ``vft_<prefix of its API key>_<sealed, base64url>``.
"""

import re

TOKEN = re.compile(r"vf_([0-9a-f]{12})_([0-9a-f]{64})")
SUBJECT_TOKEN = re.compile(r"vft_([0-9a-f]{12})_([A-Za-z0-9_-]{128,768})")


def is_token(text: str) -> bool:
    """Tell whether a text has the format of an API key; no database is asked."""
    return TOKEN.fullmatch(text) is not None
