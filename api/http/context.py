"""Around every request: its id, its log line, the headers of every answer, and the last resort."""

import logging
import re
import secrets
import time
from typing import Any

import anyio
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.http.audit import note_refusal
from api.http.errors import ERROR_CODES, ApiError, api_error, error_answer
from api.http.schemas import NOTICE, REQUEST_ID
from api.limits.rates import RateLimits
from api.service.logging import log
from api.service.metrics import ERRORS, IN_FLIGHT, LOCKED_OUT, count_request
from models.demo import DEMO_NOTICE

SANE_REQUEST_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{7,63}")
SEND_TIMEOUT_S = 30.0
"""Longest that one piece of an answer may wait for the client to take it."""
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
}
METHODS = ("DELETE", "GET", "HEAD", "POST", "PUT")
HSTS = "max-age=31536000"
HEALTH_PATHS = frozenset({"/health/live", "/health/ready"})
"""Paths without a rate limit: what watches the service must see an overload."""


class RequestContext:
    """ASGI middleware: the one place where an exception becomes an answer.

    ``scope["state"]`` gets ``log``, fields of the request's log line that routes may add to.
    `root_path` is the path under which a proxy shows the service.
    """

    def __init__(
        self, app: ASGIApp, *, root_path: str = "", demo: bool = False, tls: bool = False
    ) -> None:
        self._app = app
        self._root_path = root_path
        self._notice = DEMO_NOTICE if demo else None
        self._headers = dict(SECURITY_HEADERS)
        if tls:
            self._headers["Strict-Transport-Security"] = HSTS
        if demo:
            self._headers["X-Veilface-Notice"] = DEMO_NOTICE

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._start_and_stop(scope, receive, send)
            return
        request_id = Headers(scope=scope).get("x-request-id", "")
        if not SANE_REQUEST_ID.fullmatch(request_id):
            request_id = secrets.token_hex(16)
        REQUEST_ID.set(request_id)
        NOTICE.set(self._notice)
        fields: dict[str, Any] = {}
        scope.setdefault("state", {})["log"] = fields
        scope["root_path"] = self._root_path
        started, status = time.perf_counter(), 0

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            # A client that takes nothing of its answer must not keep its place for ever.
            with anyio.move_on_after(SEND_TIMEOUT_S):
                await send(message)
                return
            raise ClientDisconnect

        IN_FLIGHT.inc()
        try:
            await _require_few_requests(scope)
            await self._app(scope, receive, send_with_headers)
        except ClientDisconnect:
            fields["code"] = "client_disconnected"
        except Exception as error:
            refusal = await _refusal(Request(scope), error)
            if status == 0:
                await error_answer(refusal, request_id)(scope, receive, send_with_headers)
        finally:
            IN_FLIGHT.dec()
            route, code = getattr(scope.get("route"), "path", None), fields.get("code")
            seconds = time.perf_counter() - started
            if code in ERROR_CODES:
                ERRORS.labels(code).inc()
            count_request(route=route, method=scope["method"], status=status, seconds=seconds)
            log(
                "request",
                severity=logging.ERROR if code == "internal_error" else logging.INFO,
                request_id=request_id,
                method=scope["method"],
                route=route,
                status=status,
                duration_ms=round(1e3 * seconds, 2),
                **fields,
            )

    async def _start_and_stop(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on the life of the worker, without the text of what ended it.

        Starlette sends the traceback along, and the server would log it; both may hold anything.
        """

        async def send_without_text(message: Message) -> None:
            await send({name: value for name, value in message.items() if name != "message"})

        try:
            await self._app(scope, receive, send_without_text)
        except Exception as error:
            log("worker failed", severity=logging.ERROR, error_type=type(error).__name__)
            raise


async def _refusal(request: Request, error: Exception) -> ApiError:
    """Return what an exception is answered with, after everybody was told who must know of it."""
    refusal = api_error(error)
    fields = request.state.log
    fields["code"] = refusal.code
    if refusal.code == "method_not_allowed":
        refusal.headers = {"Allow": _methods(request.scope)}
    if error is not refusal:
        # The exception's text may hold anything; its type is all that leaves this place.
        fields["error_type"] = type(error).__name__
    if refusal.code == "locked_out":
        LOCKED_OUT.labels("disabled" if refusal.details["disabled"] else "locked").inc()
    request.app.state.readiness.note(error)
    await note_refusal(request, refusal, error)
    return refusal


def _methods(scope: Scope) -> str:
    """List the methods of all routes at a path; the framework names one route's only."""

    def taken(method: str) -> bool:
        asked = {**scope, "method": method}
        return any(route.matches(asked)[0] is Match.FULL for route in scope["app"].routes)

    return ", ".join(filter(taken, METHODS))


async def _require_few_requests(scope: Scope) -> None:
    """Refuse a client's address that sends too many, and a path that names another one."""
    if scope["path"].removeprefix(scope["root_path"]) not in HEALTH_PATHS:
        rate_limits: RateLimits = scope["app"].state.rate_limits
        await rate_limits.count_address(scope)
    if b"%2f" in scope.get("raw_path", b"").lower():
        # Routes see it decoded: an id that a visitor chose would select another call.
        raise ApiError("validation_failed", "the path has an encoded slash: no id has one")
