"""How both clients connect: the address, the key, time limits."""

import re
import ssl
from typing import Any

import httpx

DEFAULT_TIMEOUT = httpx.Timeout(60.0, connect=5.0, pool=5.0)
"""Ten large photos on a busy service take a while; a connection does not."""

_VISIBLE = re.compile(r"[\x21-\x7e]+")
# Less than the 5 s after which the service closes an idle connection: a request that meets the
# close is lost, and a verification that is lost is not sent again.
_LIMITS = httpx.Limits(max_connections=100, max_keepalive_connections=20, keepalive_expiry=2.0)


def options(
    url: str, token: str, *, timeout: httpx.Timeout | float, verify: ssl.SSLContext | bool
) -> dict[str, Any]:
    """Return the arguments of httpx's clients.

    Raises
    ------
    ValueError
        The URL or the key cannot be one. The text repeats neither.
    """
    try:
        base = httpx.URL(url)
    except httpx.InvalidURL:
        base = httpx.URL("")
    if base.scheme not in ("http", "https") or not base.host or base.userinfo or base.query:
        raise ValueError("the URL is that of the service: https://HOST[:PORT], without a password")
    # httpx would repeat a header that it cannot send in its error.
    if not _VISIBLE.fullmatch(token):
        raise ValueError("the API key has a character that no API key has, or is empty")
    return {
        "base_url": base,
        "headers": {"Authorization": f"Bearer {token}", "Accept": "application/json, */*"},
        "timeout": timeout,
        "verify": verify,
        "limits": _LIMITS,
        "follow_redirects": False,
    }
