"""Calls from pages of other origins: which are allowed, and what a browser is told.

Keys travel in ``Authorization`` or ``X-API-Key`` and never in a cookie, so credentials are not
allowed: a page can call with a key that it has, and with nothing that the browser keeps for the
service.
"""

from collections.abc import Collection

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import Scope

PATHS = "/v1/"
MAX_AGE_S = 600
METHODS = ("GET", "PUT", "POST", "DELETE")
REQUEST_HEADERS = (
    "Authorization",
    "Content-Type",
    "If-Match",
    "If-None-Match",
    "X-API-Key",
    "X-Request-ID",
)
ANSWER_HEADERS = (
    "ETag",
    "Retry-After",
    "X-Decoy-Source-ID",
    "X-Request-ID",
    "X-Veilface-Notice",
)


class Cors:
    """What browsers are told of calls from other origins, by the setting ``cors_origins``."""

    def __init__(self, origins: Collection[str]) -> None:
        self._origins = frozenset(origins)

    def headers(self, scope: Scope) -> dict[str, str]:
        """Return the headers of an answer; none for an origin that is not allowed."""
        if not self._origins or not scope["path"].startswith(PATHS):
            return {}
        # An answer to one origin must not be kept for another.
        vary = {"Vary": "Origin"}
        origin = Headers(scope=scope).get("origin")
        if origin not in self._origins:
            return vary
        return {
            "Access-Control-Allow-Origin": origin,
            "Access-Control-Expose-Headers": ", ".join(ANSWER_HEADERS),
            **vary,
        }

    def preflight(self, scope: Scope) -> Response | None:
        """Return the answer to a preflight of an allowed origin; None for any other request."""
        asks = "access-control-request-method" in Headers(scope=scope)
        if scope["method"] != "OPTIONS" or not asks:
            return None
        if "Access-Control-Allow-Origin" not in self.headers(scope):
            return None
        return Response(
            status_code=204,
            headers={
                "Access-Control-Allow-Methods": ", ".join(METHODS),
                "Access-Control-Allow-Headers": ", ".join(REQUEST_HEADERS),
                "Access-Control-Max-Age": str(MAX_AGE_S),
            },
        )
