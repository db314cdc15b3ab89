"""Around every request: its id, its log line, the headers of every answer, and the last resort."""

import logging
import re
import secrets
import time
from collections.abc import Awaitable, Callable, Collection
from typing import Any

import anyio
from prometheus_client import Gauge
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.http.answers import error_answer
from api.http.cors import Cors
from api.http.errors import ERROR_CODES, ApiError
from api.limits.admission import overloaded
from api.limits.rates import RateLimits
from api.service.logging import log
from api.service.metrics import IN_FLIGHT, count_error, count_request
from models.demo import DEMO_NOTICE

SANE_REQUEST_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{7,63}")
LINGER_S = 5.0
SEND_TIMEOUT_S = 30.0
"""Longest that one piece of an answer may wait for the client to take it."""
SMALL_ANSWER = 16 * 1024
"""Bytes that are sent with the end of the answer: whether the client takes them, is not awaited."""
LINGER_BYTES = 64 * 1024 * 1024
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
}
HSTS = "max-age=31536000"
OPERATIONS_IN_FLIGHT = 64
"""Requests for health and metrics that are answered at the same time, whatever else there is."""


def request_id_of(offered: str | None) -> str:
    """Return the client's request id if it is sane, or a fresh one."""
    if offered is not None and SANE_REQUEST_ID.fullmatch(offered):
        return offered
    return secrets.token_hex(16)


class _Body:
    """The request body as it is received, and its end where nobody wanted to read it.

    A server that closes a connection on which data still arrives resets it, and the client may
    never see the answer that says why. So after an answer that came early (a body that is too
    large, a key that is unknown) the rest is read and dropped, for a while.
    """

    def __init__(self, scope: Scope, receive: Receive) -> None:
        headers = Headers(scope=scope)
        self._receive = receive
        self._expects_continue = "expect" in headers
        self._ended = "content-length" not in headers and "transfer-encoding" not in headers

    async def receive(self) -> Message:
        message = await self._receive()
        self._expects_continue = False
        self._ended = message["type"] != "http.request" or not message.get("more_body", False)
        return message

    @property
    def ended(self) -> bool:
        """Whether all of it was received, or nobody will read the rest."""
        return self._ended

    def abandon(self) -> None:
        """Read nothing more."""
        self._ended = True

    async def linger(self) -> None:
        """Drop what still comes. A client that waits for ``100 Continue`` is not sent it."""
        dropped = 0
        with anyio.move_on_after(LINGER_S):
            while not self._ended and not self._expects_continue and dropped < LINGER_BYTES:
                message = await self.receive()
                dropped += len(message.get("body", b""))


class _InFlightLimit:
    """A bound on requests that are answered at the same time, and their number as a metric."""

    def __init__(self, most: int, gauge: Gauge | None = None) -> None:
        self._most = self._free = most
        self._gauge = gauge

    @property
    def crowded(self) -> bool:
        """Whether more than half of it is taken."""
        return 2 * self._free < self._most

    def take(self) -> bool:
        """Take a place, if there is one."""
        if self._free <= 0:
            return False
        self._free -= 1
        if self._gauge is not None:
            self._gauge.inc()
        return True

    def give_back(self) -> None:
        """Give a place back."""
        self._free += 1
        if self._gauge is not None:
            self._gauge.dec()


class RequestContext:
    """ASGI middleware; it sits outside of all exception handlers.

    ``scope["state"]`` gets ``request_id`` and ``log``, a dictionary of fields for the request's
    log line that routes may add to.

    Parameters
    ----------
    max_in_flight
        Requests that are answered at the same time; the next one is refused unread.
    operations_paths
        Paths that have a limit of their own, and no rate limit: an overload must be seen from them.
    cors
        Which pages of other origins may call.
    demo, tls
        What the headers of every answer say.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        max_in_flight: int,
        operations_paths: Collection[str] = frozenset(),
        cors: Cors | None = None,
        demo: bool = False,
        tls: bool = False,
    ) -> None:
        self._app = app
        self._operations_paths = operations_paths
        self._cors = Cors(()) if cors is None else cors
        self._limit = _InFlightLimit(max_in_flight, IN_FLIGHT)
        self._operations_limit = _InFlightLimit(OPERATIONS_IN_FLIGHT)
        self._headers = dict(SECURITY_HEADERS)
        if tls:
            self._headers["Strict-Transport-Security"] = HSTS
        if demo:
            self._headers["X-Veilface-Notice"] = DEMO_NOTICE

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] == "lifespan":
            await self._start_and_stop(scope, receive, send)
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = request_id_of(Headers(scope=scope).get("x-request-id"))
        state = scope.setdefault("state", {})
        fields: dict[str, Any] = {}
        state["request_id"], state["log"] = request_id, fields
        started, status = time.perf_counter(), 0
        body = _Body(scope, receive)

        async def deliver(message: Message) -> None:
            # A client that takes nothing of its answer must not keep its place for ever.
            with anyio.move_on_after(SEND_TIMEOUT_S):
                await send(message)
                return
            raise ClientDisconnect

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            last = message["type"] == "http.response.body" and not message.get("more_body")
            if last and not (body.ended and len(message.get("body", b"")) <= SMALL_ANSWER):
                # The end, sent by itself, waits until the client has taken most of the rest.
                await deliver({**message, "more_body": True})
                # Lingering is a courtesy: with it, nobody without a key shall use up the limit.
                if not self._limit.crowded:
                    await body.linger()
                message = {"type": "http.response.body", "body": b""}
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                for name, value in (self._headers | self._cors.headers(scope)).items():
                    headers.setdefault(name, value)
            await deliver(message)

        async def refuse(refusal: ApiError) -> None:
            fields["code"] = refusal.code
            await error_answer(refusal, request_id)(scope, receive, send_with_headers)

        try:
            await self._admit(scope, body, send_with_headers, refuse)
        except ClientDisconnect:
            fields["code"] = "client_disconnected"
        except Exception as error:
            # The exception's text may hold anything; its type is all that leaves this place.
            fields["error_type"], fields["code"] = type(error).__name__, "internal_error"
            if status == 0:
                answer = error_answer(
                    ApiError("internal_error", "the service failed; report the request id"),
                    request_id,
                )
                await answer(scope, receive, send_with_headers)
        finally:
            route, code = getattr(scope.get("route"), "path", None), fields.get("code")
            seconds = time.perf_counter() - started
            if code in ERROR_CODES:
                count_error(code)
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

    async def _admit(
        self, scope: Scope, body: _Body, send: Send, refuse: Callable[[ApiError], Awaitable[None]]
    ) -> None:
        """Pass a request on if the limit allows it and its client's address sends few enough."""
        operations = scope["path"] in self._operations_paths
        limit = self._operations_limit if operations else self._limit
        if not limit.take():
            # Reading on would hold what the limit is there to refuse.
            body.abandon()
            await refuse(overloaded())
            return
        try:
            if not operations:
                rate_limits: RateLimits = scope["app"].state.rate_limits
                await rate_limits.count_address(scope)
            if b"%2f" in scope.get("raw_path", b"").lower():
                # Routes see it decoded: an id that a visitor chose would select another call.
                raise ApiError("validation_failed", "the path has an encoded slash: no id has one")
            await (self._cors.preflight(scope) or self._app)(scope, body.receive, send)
        except ApiError as refusal:
            await refuse(refusal)
        finally:
            limit.give_back()

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
