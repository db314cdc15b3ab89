"""Signatures of lifted probes, as the service's REST reference states them (Signed probes)."""

import base64
import hashlib
import hmac
import re
import secrets
import time
from typing import Any

TOKEN = re.compile(r"vf_[0-9a-f]{12}_([0-9a-f]{64})")
SUBJECT_TOKEN = re.compile(r"vft_[0-9a-f]{12}_[A-Za-z0-9_-]{128,768}")

_INFO = b"veilface/1/probe-key"


def signed_probe(
    token: str, subject_id: str, template: bytes, *, level: str | None = None
) -> dict[str, Any]:
    """Return the JSON body of a verification, with a nonce of its own: good for one sending.

    Notes
    -----
    The key is HKDF-SHA256 (RFC 5869) of the secret part of the API key, or of the whole text of a
    token for a browser, without salt; one block of output is all 32 bytes of it.
    """
    extracted = hmac.digest(bytes(32), _secret_of(token), "sha256")
    key = hmac.digest(extracted, _INFO + b"\x01", "sha256")
    nonce, timestamp = secrets.token_urlsafe(18), int(time.time())
    lines = (
        "veilface-probe-1",
        subject_id,
        level or "",
        "template",
        hashlib.sha256(template).hexdigest(),
        nonce,
        str(timestamp),
    )
    body: dict[str, Any] = {
        "template": base64.b64encode(template).decode("ascii"),
        "nonce": nonce,
        "timestamp": timestamp,
        "hmac": hmac.digest(key, "\n".join(lines).encode(), "sha256").hex(),
    }
    return body if level is None else {**body, "level": level}


def signs(token: str) -> bool:
    """Whether probes can be signed with it: an API key, or a token for a browser."""
    return bool(TOKEN.fullmatch(token) or SUBJECT_TOKEN.fullmatch(token))


def _secret_of(token: str) -> bytes:
    match = TOKEN.fullmatch(token)
    if match is not None:
        return bytes.fromhex(match[1])
    if SUBJECT_TOKEN.fullmatch(token) is None:
        raise ValueError("only an API key or a token of the service signs probes")
    return token.encode("ascii")
