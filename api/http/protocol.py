"""HTTP/1.1 on a connection: uvicorn's protocol on httptools, with a bound on what is not a body.

llhttp, the parser, refuses what two servers could read differently: two lengths, a length beside
chunks, a folded header. But it takes a request line, headers and chunks of any number, and keeps
the headers. One bound covers them all. A refusal has the shape of all errors.
"""

import secrets

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from api.http.errors import ApiError, error_answer
from api.service.metrics import ERRORS

MAX_FRAMING_BYTES = 16 * 1024
"""Bytes of a request that are not its body: request line, headers, sizes of chunks, trailers."""

FRAMING_SHARE = 8
"""So many bytes of body allow one further byte of framing, which chunks of 64 bytes need."""

MAX_PIPELINED = 16
"""Requests that may wait on a connection for the answer to an earlier one. uvicorn keeps all that
one read brings, at about 1 kB each, before anybody has shown a key."""


class Protocol(HttpToolsProtocol):
    """uvicorn's protocol, which refuses too large a framing and too many requests at once."""

    _framing_bytes = 0

    def data_received(self, data: bytes) -> None:
        """Parse in pieces: a head below the bound passes and one of twice the bound never does."""
        for start in range(0, len(data), MAX_FRAMING_BYTES):
            piece = data[start : start + MAX_FRAMING_BYTES]
            self._framing_bytes += len(piece)
            super().data_received(piece)
            if self.transport.is_closing():
                return
            if self._framing_bytes > MAX_FRAMING_BYTES:
                self.send_400_response(
                    f"headers and chunk sizes have more than {MAX_FRAMING_BYTES} bytes: send fewer "
                    "or shorter headers, and the body with a Content-Length or in larger chunks"
                )
                return
            if len(self.pipeline) > MAX_PIPELINED:
                self.send_400_response(
                    f"more than {MAX_PIPELINED} requests wait for answers on one connection: send "
                    "fewer before you read"
                )
                return

    def on_message_begin(self) -> None:
        """Count anew: this is another request."""
        super().on_message_begin()
        self._framing_bytes = 0

    def on_body(self, body: bytes) -> None:
        """Take a piece of the body, which is no framing; no body earns more than one more bound."""
        super().on_body(body)
        self._framing_bytes -= len(body) + len(body) // FRAMING_SHARE
        self._framing_bytes = max(self._framing_bytes, -MAX_FRAMING_BYTES)

    def send_400_response(self, msg: str) -> None:
        """Answer in the shape of all errors, unless an answer has begun; close the connection."""
        # Where requests wait, an earlier one than the last is being answered.
        cycle, waiting = self.cycle, bool(self.pipeline)
        self.pipeline.clear()
        answering = waiting or (
            cycle is not None and cycle.response_started and not cycle.response_complete
        )
        if cycle is not None and not cycle.response_complete:
            cycle.disconnected = True
            cycle.message_event.set()
        if not answering:
            refusal = ApiError("malformed_request", msg.removesuffix(" received."))
            ERRORS.labels(refusal.code).inc()
            request_id = secrets.token_hex(16)
            answer = error_answer(refusal, request_id)
            headers = {**answer.headers, "x-request-id": request_id, "connection": "close"}
            lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
            head = f"HTTP/1.1 400 Bad Request\r\n{lines}\r\n"
            self.transport.write(head.encode("latin-1") + bytes(answer.body))
        self.transport.close()
