"""The signature of a probe that is not a photo: checked before anything is computed."""

import hmac
import time
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from api.http.errors import ApiError
from templates.keys.probe_signature import MAX_TIMESTAMP, NONCE, probe_mac
from templates.store.lockout import Nonce, Replayed

FIELDS = ("nonce", "timestamp", "hmac")


def checked_signature(
    body: Mapping[str, Any],
    probe: bytes | NDArray[np.float64],
    *,
    key: bytes,
    subject_id: str,
    level: str | None,
) -> tuple[str, int]:
    """Check the signature of a probe; return its nonce and timestamp, which are any.

    Parameters
    ----------
    body
        The request, with the fields ``nonce``, ``timestamp`` and ``hmac``.
    probe
        Wire bytes, or the numbers of an embedding, (n,) float64, or of several, (k, n).
    key
        The probe key of the API key, or of the token, that the request came with.

    Raises
    ------
    ApiError
        ``validation_failed`` for a field that is missing or no nonce, time or HMAC;
        ``unauthorized`` where the HMAC is another one than that of this probe.
    """
    nonce, timestamp, mac = (body.get(name) for name in FIELDS)
    if not isinstance(nonce, str) or not NONCE.fullmatch(nonce):
        raise _field("nonce", "16 to 64 characters out of A-Z a-z 0-9 _ -, drawn for this probe")
    if type(timestamp) is not int or not 0 <= timestamp < MAX_TIMESTAMP:
        raise _field("timestamp", "whole seconds since 1970, UTC")
    if not isinstance(mac, str) or len(mac) != 64 or not mac.isascii():
        raise _field("hmac", "64 hexadecimal digits")
    expected = probe_mac(key, subject_id, probe, level=level, nonce=nonce, timestamp=timestamp)
    if not hmac.compare_digest(expected, mac):
        raise ApiError(
            "unauthorized",
            "the probe's hmac is not that of these fields under this API key or token; "
            "docs/rest.md says what is signed",
            {"field": "hmac"},
        )
    return nonce, timestamp


def nonce_in_time(nonce: str, timestamp: int, *, key_prefix: str, window_s: float) -> Nonce:
    """Return the nonce of a probe that an API key signed, which the decision will use up.

    Parameters
    ----------
    window_s
        Seconds that the timestamp may be away from this machine's clock, either way.

    Raises
    ------
    Replayed
        Where it is further away.
    """
    if abs(time.time() - timestamp) > window_s:
        raise Replayed(
            f"the probe's timestamp is more than {window_s:g} s away from the server's clock: "
            "set the client's clock, and sign each probe when it is sent"
        )
    # Kept until the timestamp alone would refuse it, a second longer for the rounding.
    expires = datetime.fromtimestamp(timestamp, UTC) + timedelta(seconds=window_s + 1)
    return Nonce(key_prefix=key_prefix, value=nonce, expires_at=expires)


def _field(name: str, rule: str) -> ApiError:
    return ApiError(
        "validation_failed",
        f"a probe that is not a photo must be signed: {name} must be {rule}",
        {"field": name},
    )
