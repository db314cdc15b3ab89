"""Signatures of probes, so that a probe that was captured cannot be sent again.

A client that sends embeddings or a lifted template adds three fields: ``nonce``, ``timestamp`` and
``hmac``. The text that is signed has seven lines, without a line break at the end::

    veilface-probe-1
    <subject id>
    <level, or nothing>
    <"embedding", "embeddings" or "template">
    <SHA-256 of the probe's bytes, 64 hexadecimal digits>
    <nonce>
    <timestamp>

``hmac`` is its HMAC-SHA256 (RFC 2104), 64 hexadecimal digits, under the probe key: HKDF of the
secret part of the API key (``templates.keys.api_token.probe_key``). The bytes of a template are its
wire bytes; those of an embedding are its numbers as little-endian float64, with 0 for -0, because
JSON writers do not agree on the latter. Those of several embeddings are the SHA-256 of each, 32
bytes, one after the other: so it is signed where each of them ends.
"""

import base64
import hashlib
import hmac
import re
import secrets
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from templates.keys.api_token import probe_key

NONCE = re.compile(r"[A-Za-z0-9_-]{16,64}")
MAX_TIMESTAMP = 2**53

_VERSION = "veilface-probe-1"


@dataclass(frozen=True)
class ProbeSignature:
    """What a client adds to a probe.

    Attributes
    ----------
    nonce
        16 to 64 characters of the URL-safe base64 alphabet, at random, never used twice.
    timestamp
        Seconds since 1970 (UTC) by the client's clock.
    hmac
        64 lower-case hexadecimal digits.
    """

    nonce: str
    timestamp: int
    hmac: str

    def fields(self) -> dict[str, Any]:
        """Return the three fields as they stand in the request."""
        return {"nonce": self.nonce, "timestamp": self.timestamp, "hmac": self.hmac}


def sign_probe(
    token: str,
    subject_id: str,
    probe: bytes | NDArray[np.floating],
    *,
    level: str | None = None,
    nonce: str | None = None,
    timestamp: int | None = None,
) -> ProbeSignature:
    """Sign a probe with an API key.

    Parameters
    ----------
    token
        The API key that the request is sent with.
    probe : bytes, (n,) or (k, n) floating
        Wire bytes of a lifted probe; an embedding, or several of one person, with exactly the
        numbers that are sent.
    level
        As the request names it; None where it names none.
    nonce, timestamp
        Drawn, and read from the clock, where not given.

    Raises
    ------
    StoreError
        If the text is not a token.
    """
    nonce = secrets.token_urlsafe(18) if nonce is None else nonce
    timestamp = int(time.time()) if timestamp is None else timestamp
    mac = probe_mac(
        probe_key(token), subject_id, probe, level=level, nonce=nonce, timestamp=timestamp
    )
    return ProbeSignature(nonce, timestamp, mac)


def signed_probe(
    token: str,
    subject_id: str,
    probe: bytes | NDArray[np.floating],
    *,
    level: str | None = None,
) -> dict[str, Any]:
    """Return the JSON body of a verification: the probe and its signature, good for one sending.

    Parameters as in :func:`sign_probe`.
    """
    signature = sign_probe(token, subject_id, probe, level=level)
    kind = _kind(probe)
    sent: dict[str, Any] = {
        kind: base64.b64encode(probe).decode("ascii")
        if isinstance(probe, bytes)
        else probe.astype(np.float64).tolist()
    }
    if level is not None:
        sent["level"] = level
    return {**sent, **signature.fields()}


def probe_mac(
    key: bytes,
    subject_id: str,
    probe: bytes | NDArray[np.floating],
    *,
    level: str | None,
    nonce: str,
    timestamp: int,
) -> str:
    """HMAC-SHA256 of a probe under a probe key, 64 hexadecimal digits."""
    if isinstance(probe, bytes):
        body = probe
    elif probe.ndim == 2:
        body = b"".join(hashlib.sha256(_number_bytes(row)).digest() for row in probe)
    else:
        body = _number_bytes(probe)
    lines = (
        _VERSION,
        subject_id,
        level or "",
        _kind(probe),
        hashlib.sha256(body).hexdigest(),
        nonce,
        str(timestamp),
    )
    return hmac.new(key, "\n".join(lines).encode(), hashlib.sha256).hexdigest()


def _kind(probe: bytes | NDArray[np.floating]) -> str:
    """Name the field that holds the probe."""
    if isinstance(probe, bytes):
        return "template"
    return "embeddings" if probe.ndim == 2 else "embedding"


def _number_bytes(embedding: NDArray[np.floating]) -> bytes:
    # Adding 0 turns -0 into 0 and changes nothing else.
    return (embedding.astype(np.float64) + 0.0).astype("<f8").tobytes()
