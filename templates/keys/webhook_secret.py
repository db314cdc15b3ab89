"""Secrets that webhooks are signed with, and the signature, in the form of Standard Webhooks.

A secret is text: ``whsec_`` and the base64 of 24 to 64 random bytes. A message is signed with each
secret of the file, so that a receiver may still have the one before.
"""

import base64
import binascii
import hashlib
import hmac
from collections.abc import Sequence
from pathlib import Path

from templates.errors import SealError
from templates.keys.bounded_file import read_private

PREFIX = "whsec_"
_MAX_FILE_BYTES = 4096
_BYTES = range(24, 65)


def read_webhook_secrets(path: Path) -> tuple[bytes, ...]:
    """Read a private file with one secret on a line, the current one first.

    Raises
    ------
    SealError
        If there is no such file, others may read it, or a line holds no secret.
    """
    source = f"the webhook secret file {path}"
    data = read_private(path, _MAX_FILE_BYTES, source=source, remedy="`chmod 600` it")
    lines = data.decode("ascii", errors="replace").split()
    secrets = tuple(_decoded(line, source) for line in lines)
    if not secrets or len(data) > _MAX_FILE_BYTES:
        raise SealError(f"{source} must hold one secret on a line, {PREFIX}…, and no more")
    return secrets


def _decoded(line: str, source: str) -> bytes:
    try:
        secret = base64.b64decode(line.removeprefix(PREFIX), validate=True)
    except (binascii.Error, ValueError):
        secret = b""
    if len(secret) not in _BYTES:
        raise SealError(
            f"{source} has a line that is no secret: write {PREFIX} and the base64 of "
            f"{_BYTES.start} to {_BYTES.stop - 1} random bytes"
        )
    return secret


def signatures(secrets: Sequence[bytes], message_id: str, timestamp: int, body: str) -> str:
    """Return the header ``webhook-signature``: one signature by each secret."""
    message = f"{message_id}.{timestamp}.{body}".encode()
    macs = (hmac.digest(secret, message, hashlib.sha256) for secret in secrets)
    return " ".join(f"v1,{base64.b64encode(mac).decode()}" for mac in macs)
