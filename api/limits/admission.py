"""Limits before allocation: how much of a body is read, who may send one, and what computes."""

from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

import anyio
import anyio.to_thread
from starlette.requests import Request

from api.http.errors import ApiError
from api.service.metrics import COMPUTE_WAITING

MAX_JSON_BYTES = 4 * 1024 * 1024
"""Largest JSON body. The largest template that the wire format admits, in base64, fits."""

MAX_WAITING_QUERIES = 256
"""Requests that may wait for their turn to ask the database, most of all whose API key it is."""

RETRY_AFTER_S = 1

T = TypeVar("T")


async def stream_limited(request: Request, limit: int) -> AsyncGenerator[bytes, None]:
    """Yield the body; refuse it as soon as it is known to be larger than ``limit`` bytes.

    A declared length may lie, and a chunked body declares none: so both lengths count.
    """
    too_large = ApiError(
        "request_too_large",
        f"the request body is larger than {limit} bytes",
        {"limit_bytes": limit},
        {"Connection": "close"},
    )
    declared = request.headers.get("content-length", "0")
    if not (declared.isascii() and declared.isdecimal()):
        raise ApiError("malformed_request", "Content-Length is not a number")
    # A length of twenty digits is refused without converting it.
    if len(declared) > 18 or int(declared) > limit:
        raise too_large
    seen = 0
    async for chunk in request.stream():
        seen += len(chunk)
        if seen > limit:
            raise too_large
        yield chunk


async def read_limited(request: Request, limit: int) -> bytes:
    """Read the whole body into memory, at most ``limit`` bytes of it."""
    return b"".join([chunk async for chunk in stream_limited(request, limit)])


class Gate:
    """Bounds the requests with a body in one worker, those that compute, and those that query.

    One API key has at most half of the places, and half of the threads that compute. So it delays
    another key by no queue, and still uses all processors while it is alone.

    ``slots`` requests of one key may compute at the same time, twice as many of all keys, and
    ``waiting`` more may send their body or wait for a slot, which bounds the memory for bodies.
    """

    def __init__(self, *, slots: int, waiting: int) -> None:
        self._slots = slots
        self._compute = anyio.CapacityLimiter(2 * slots)
        self._compute_of: dict[str, anyio.CapacityLimiter] = {}
        self._queries = anyio.CapacityLimiter(max(4, 2 * slots))
        self._places = 2 * slots + waiting
        self._taken: Counter[str] = Counter()
        self._asking = 0

    @asynccontextmanager
    async def admitted(self, key: str) -> AsyncIterator[None]:
        """Take a place for an API key, from before the body is read until the answer is known."""
        if self._taken.total() >= self._places or self._taken[key] >= self._places // 2:
            raise overloaded()
        self._taken[key] += 1
        try:
            yield
        finally:
            self._taken[key] -= 1
            if not self._taken[key]:
                del self._taken[key]

    async def compute(self, work: Callable[[], T], *, key: str) -> T:
        """Run ``work`` in a thread, once there is one for ``key``, which names who asks."""
        of_key = self._compute_of.setdefault(key, anyio.CapacityLimiter(self._slots))
        try:
            with COMPUTE_WAITING.track_inprogress():
                await of_key.acquire()
            try:
                return await anyio.to_thread.run_sync(work, limiter=self._compute)
            finally:
                of_key.release()
        finally:
            if not of_key.borrowed_tokens and not of_key.statistics().tasks_waiting:
                self._compute_of.pop(key, None)

    async def query(self, work: Callable[[], T]) -> T:
        """Run ``work``, which asks the database and computes little, in a thread."""
        # Bounded: anybody may make a request wait here, with a token of their own making.
        if self._asking >= self._queries.total_tokens + MAX_WAITING_QUERIES:
            raise overloaded()
        self._asking += 1
        try:
            return await anyio.to_thread.run_sync(work, limiter=self._queries)
        finally:
            self._asking -= 1


def overloaded() -> ApiError:
    """Return the refusal of a request for which there is no place."""
    return ApiError(
        "overloaded",
        "too many requests are waiting; try again shortly",
        {},
        {"Retry-After": str(RETRY_AFTER_S)},
    )
