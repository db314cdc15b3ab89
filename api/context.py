"""Around every request: its id, its log line, the headers of every answer, and the last resort."""

import logging
import re
import secrets
import time
from typing import Any

import anyio
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.answers import error_answer
from api.errors import ApiError
from api.logging import log
from models.demo import DEMO_NOTICE

SANE_REQUEST_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{7,63}")
LINGER_S = 5.0
LINGER_BYTES = 64 * 1024 * 1024
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
}


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

    async def linger(self) -> None:
        """Drop what still comes. A client that waits for ``100 Continue`` is not sent it."""
        dropped = 0
        with anyio.move_on_after(LINGER_S):
            while not self._ended and not self._expects_continue and dropped < LINGER_BYTES:
                message = await self.receive()
                dropped += len(message.get("body", b""))


class RequestContext:
    """ASGI middleware; it sits outside of all exception handlers.

    ``scope["state"]`` gets ``request_id`` and ``log``, a dictionary of fields for the request's
    log line that routes may add to.
    """

    def __init__(self, app: ASGIApp, *, demo: bool = False) -> None:
        self._app = app
        self._demo = demo

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

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.body" and not message.get("more_body"):
                await send({**message, "more_body": True})
                await body.linger()
                message = {"type": "http.response.body", "body": b""}
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                if self._demo:
                    headers["X-Veilface-Notice"] = DEMO_NOTICE
            await send(message)

        try:
            await self._app(scope, body.receive, send_with_headers)
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
            route = scope.get("route")
            log(
                "request",
                severity=logging.ERROR if fields.get("code") == "internal_error" else logging.INFO,
                request_id=request_id,
                method=scope["method"],
                route=getattr(route, "path", None),
                status=status,
                duration_ms=round(1e3 * (time.perf_counter() - started), 2),
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
