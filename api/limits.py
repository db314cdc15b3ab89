"""Limits before allocation: how much of a body is read, for how long, and what waits for a turn."""

import time
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

import anyio
import anyio.to_thread
from starlette.requests import Request

from api.errors import ApiError
from api.metrics import COMPUTE_WAITING

MAX_JSON_BYTES = 4 * 1024 * 1024
"""Largest JSON body. The largest template that the wire format admits, in base64, fits."""

MAX_WAITING_QUERIES = 256
"""Requests that may wait for their turn to ask the database, most of all whose API key it is."""

RETRY_AFTER_S = 1
SEEN_S = 60.0
"""Seconds for which a key that asked counts as one that shares the places for bodies."""

T = TypeVar("T")


async def stream_limited(request: Request, limit: int) -> AsyncGenerator[bytes, None]:
    """Yield the body, and stop as soon as it is known to be larger than ``limit`` bytes.

    Both the declared and the real length count: a chunked body declares none, and a declared one
    may lie.

    Raises
    ------
    ApiError
        ``request_too_large``.
    """
    too_large = ApiError(
        "request_too_large",
        f"the request body is larger than {limit} bytes",
        {"limit_bytes": limit},
        {"Connection": "close"},
    )
    declared = request.headers.get("content-length")
    if declared is not None:
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
    body = bytearray()
    async for chunk in stream_limited(request, limit):
        body += chunk
    return bytes(body)


class Gate:
    """Lets a bounded number of requests into one worker, and fewer of them compute at a time.

    Parameters
    ----------
    slots : int
        Requests that may compute at the same time.
    waiting : int
        Requests that may be inside and not compute: they send their body, or wait for a slot.
        With the largest body, this bounds the memory for bodies.
    """

    def __init__(self, *, slots: int, waiting: int) -> None:
        self._slots = anyio.CapacityLimiter(slots)
        # Never short of threads: it has one for each slot.
        self._threads = anyio.CapacityLimiter(slots)
        self._queries = anyio.CapacityLimiter(max(4, 2 * slots))
        self._room = slots + waiting
        self._share = max(1, 3 * self._room // 4)
        self._held: Counter[str] = Counter()
        self._seen: dict[str, float] = {}
        self._asking = 0
        self._waiting = 0

    @property
    def computing(self) -> int:
        """Requests that compute now."""
        return int(self._slots.borrowed_tokens)

    @property
    def waiting(self) -> int:
        """Requests that wait for a compute slot now."""
        return self._waiting

    @asynccontextmanager
    async def admitted(self, key: str) -> AsyncIterator[None]:
        """Hold a place from before the body is read until the answer is known.

        One API key may take all places while it is alone. Once another one asked within the last
        minute, in vain or not, no key gets more than three quarters of them: who sends many bodies
        slowly keeps nobody else out.

        Parameters
        ----------
        key
            Prefix of the API key.

        Raises
        ------
        ApiError
            ``overloaded``, with ``Retry-After``.
        """
        now = time.monotonic()
        self._seen[key] = now
        self._seen = {name: at for name, at in self._seen.items() if now - at < SEEN_S}
        if self._room <= 0 or (len(self._seen) > 1 and self._held[key] >= self._share):
            raise overloaded()
        self._room -= 1
        self._held[key] += 1
        try:
            yield
        finally:
            self._room += 1
            self._held[key] -= 1
            if not self._held[key]:
                del self._held[key]

    async def compute(self, work: Callable[[], T]) -> T:
        """Run ``work`` in a thread, once a slot is free."""
        turn = object()
        try:
            self._slots.acquire_on_behalf_of_nowait(turn)
        except anyio.WouldBlock:
            await self._wait_for_a_slot(turn)
        try:
            return await anyio.to_thread.run_sync(work, limiter=self._threads)
        finally:
            self._slots.release_on_behalf_of(turn)

    async def _wait_for_a_slot(self, turn: object) -> None:
        self._waiting += 1
        COMPUTE_WAITING.inc()
        try:
            await self._slots.acquire_on_behalf_of(turn)
        finally:
            self._waiting -= 1
            COMPUTE_WAITING.dec()

    async def query(self, work: Callable[[], T]) -> T:
        """Run ``work``, which asks the database and computes little, in a thread.

        Raises
        ------
        ApiError
            ``overloaded``: anybody may make a request wait here, with a token of his own making.
        """
        if self._asking >= self._queries.total_tokens + MAX_WAITING_QUERIES:
            raise overloaded()
        self._asking += 1
        try:
            return await anyio.to_thread.run_sync(work, limiter=self._queries)
        finally:
            self._asking -= 1


def overloaded() -> ApiError:
    """Return the refusal of a request for which there is no room."""
    return ApiError(
        "overloaded",
        "too many requests wait already; try again shortly",
        {},
        {"Retry-After": str(RETRY_AFTER_S)},
    )
