"""HTTP/1.1 on a connection: what is refused of a request before the application sees it.

uvicorn's protocol on h11, with bounds that neither has. Whatever it refuses, it answers in the
shape of all errors, and closes the connection: where the next request would begin is not known.
"""

import asyncio
import re
import secrets
from http import HTTPStatus

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from api.http.answers import error_answer
from api.http.context import LINGER_S, SECURITY_HEADERS
from api.http.errors import ApiError
from api.service.logging import log
from api.service.metrics import count_error

MAX_HEAD_BYTES = 16 * 1024
"""Request line and headers. h11 bounds only what is incomplete; what comes at once, it takes."""
MAX_HEADERS = 100

CHUNKS = 128
"""Chunks of a body that may be as small as they like."""
MEAN_CHUNK_BYTES = 512
"""Least mean size of the further ones. A chunk takes 5 us of the event loop, however small it is:
those of one byte a second of it for 1.2 MB."""

_END_OF_HEAD = re.compile(rb"\n\r?\n")


class BoundedConnection(h11.Connection):
    """The server's side of a connection; what it refuses, is a violation of the protocol to h11."""

    def __init__(self) -> None:
        super().__init__(h11.SERVER, MAX_HEAD_BYTES)
        self.refusal: ApiError | None = None
        self._chunks = self._bytes = 0

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        """Return the next event that the client's bytes make.

        Raises
        ------
        h11.RemoteProtocolError
            The request is refused; ``refusal`` says why.
        """
        if self.their_state is h11.IDLE:
            self._check_size()
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._chunks = self._bytes = 0
            self._check_framing(event)
        elif isinstance(event, h11.Data):
            self._chunks += event.chunk_start
            self._bytes += len(event.data)
            if (self._chunks - CHUNKS) * MEAN_CHUNK_BYTES > self._bytes:
                self._refuse(
                    f"the body comes in chunks of less than {MEAN_CHUNK_BYTES} bytes on average: "
                    "send it with a Content-Length, or in larger chunks"
                )
        return event

    def _check_size(self) -> None:
        received = self.trailing_data[0]
        end = _END_OF_HEAD.search(received, 0, MAX_HEAD_BYTES)
        if end is None and len(received) > MAX_HEAD_BYTES:
            self._refuse(
                f"the request line and headers have more than {MAX_HEAD_BYTES} bytes: send fewer "
                "or shorter headers"
            )
        # The request line, and the empty one at the end.
        if received.count(b"\n", 0, MAX_HEAD_BYTES if end is None else end.end()) > MAX_HEADERS + 2:
            self._refuse(f"the request has more than {MAX_HEADERS} headers: send fewer")

    def _check_framing(self, request: h11.Request) -> None:
        names = [name for name, _ in request.headers]
        if b"transfer-encoding" in names:
            # What stands before us may go by the other one, and take the rest for a request.
            if b"content-length" in names:
                self._refuse("the request has both Content-Length and Transfer-Encoding: send one")
            if request.http_version < b"1.1":
                self._refuse("HTTP/1.0 has no Transfer-Encoding: send a Content-Length")

    def _refuse(self, message: str) -> None:
        self.refusal = ApiError("malformed_request", message)
        raise h11.RemoteProtocolError(message)


class Protocol(H11Protocol):
    """uvicorn's protocol with a :class:`BoundedConnection`.

    It ends a connection whose client goes on sending a body after the answer: uvicorn would read
    and drop that for as long as it comes.
    """

    conn: BoundedConnection
    _ends = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin."""
        super().connection_made(transport)
        self.conn = BoundedConnection()

    def data_received(self, data: bytes) -> None:
        """Take what came in pieces, so that h11 sees in time that trailers are too long."""
        for start in range(0, len(data), MAX_HEAD_BYTES):
            if not self._ends:
                super().data_received(data[start : start + MAX_HEAD_BYTES])

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002 - the base's
        """Answer what is no request, if no answer has begun, and end the connection."""
        request_id = secrets.token_hex(16)
        refusal = self.conn.refusal or ApiError(
            "malformed_request", "this is not a well-formed HTTP/1.1 request"
        )
        if self.cycle is not None and not self.cycle.response_complete:
            # Nobody takes what the application may still answer.
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            count_error(refusal.code)
            log("request refused", request_id=request_id, status=refusal.status, code=refusal.code)
            self._send(refusal, request_id)
        self._end()

    def _send(self, refusal: ApiError, request_id: str) -> None:
        answer = error_answer(refusal, request_id)
        headers = {**answer.headers, **SECURITY_HEADERS, "X-Request-ID": request_id}
        events = (
            h11.Response(
                status_code=answer.status_code,
                reason=HTTPStatus(answer.status_code).phrase,
                headers=[*headers.items(), ("Connection", "close")],
            ),
            h11.Data(data=bytes(answer.body)),
            h11.EndOfMessage(),
        )
        for event in events:
            self.transport.write(self.conn.send(event) or b"")

    def on_response_complete(self) -> None:
        """Go on with the next request, unless the body of this one still comes."""
        unread = self.conn.their_state is h11.SEND_BODY
        super().on_response_complete()
        if unread and not self.transport.is_closing():
            self._end()

    def _end(self) -> None:
        """Close the connection, later: a client that still sends would not see its answer."""
        self._ends = True
        self.flow.resume_reading()
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.loop.call_later(LINGER_S, self.transport.close)
