"""Limits before allocation: how much of a body is read, for how long, and what waits for a turn."""

from collections import Counter, OrderedDict, deque
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
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
MOST_OF_TOKEN = 4
"""Files that one token may fetch at the same time: a pack has two."""
SHARE = 3
"""Times as many places for bodies as are left that one API key may take."""

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


class Slots:
    """Compute slots, which go round the keys that wait for one.

    A key's own requests get theirs in the order they came. So a key with many requests delays one
    of another key by at most what runs, and by one turn for each other key that waits.

    Parameters
    ----------
    count
        Turns that may be taken at the same time.
    """

    def __init__(self, count: int) -> None:
        self._count = self._free = count
        self._waiting: OrderedDict[str, deque[anyio.Event]] = OrderedDict()

    @property
    def taken(self) -> int:
        """Turns that are taken now."""
        return self._count - self._free

    @property
    def waiting(self) -> int:
        """Turns that are waited for now."""
        return sum(map(len, self._waiting.values()))

    @asynccontextmanager
    async def turn(self, key: str) -> AsyncIterator[None]:
        """Wait for a slot, and hold it."""
        if self._free:
            self._free -= 1
        else:
            await self._wait(key)
        try:
            yield
        finally:
            self._pass_on()

    async def _wait(self, key: str) -> None:
        given = anyio.Event()
        self._waiting.setdefault(key, deque()).append(given)
        COMPUTE_WAITING.inc()
        try:
            await given.wait()
        except BaseException:
            if given.is_set():  # and nobody will take it
                self._pass_on()
            else:
                self._waiting[key].remove(given)
                if not self._waiting[key]:
                    del self._waiting[key]
            raise
        finally:
            COMPUTE_WAITING.dec()

    def _pass_on(self) -> None:
        if not self._waiting:
            self._free += 1
            return
        key, turns = self._waiting.popitem(last=False)
        turns.popleft().set()
        if turns:
            self._waiting[key] = turns


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
        self._slots = Slots(slots)
        # Never short of threads: it has one for each slot.
        self._threads = anyio.CapacityLimiter(slots)
        self._queries = anyio.CapacityLimiter(max(4, 2 * slots))
        self._free_places = slots + waiting
        self._places: Counter[str] = Counter()
        self._asking = 0

    @property
    def computing(self) -> int:
        """Requests that compute now."""
        return self._slots.taken

    @property
    def waiting(self) -> int:
        """Requests that wait for a compute slot now."""
        return self._slots.waiting

    @asynccontextmanager
    async def admitted(self, key: str) -> AsyncIterator[None]:
        """Take a place from before the body is read until the answer is known.

        A key that has places gets another one only while it would have at most three times as many
        as are then left. So one key alone gets three quarters of them, several get equal shares,
        and there is always a place for a key that has none, until there are as many keys as places.

        Parameters
        ----------
        key
            Prefix of the API key.

        Raises
        ------
        ApiError
            ``overloaded``, with ``Retry-After``.
        """
        taken, left = self._places[key] + 1, self._free_places - 1
        if left < 0 or (taken > 1 and taken > SHARE * left):
            raise overloaded()
        self._free_places = left
        self._places[key] = taken
        try:
            yield
        finally:
            self._free_places += 1
            self._places[key] -= 1
            if not self._places[key]:
                del self._places[key]

    async def compute(self, work: Callable[[], T], *, key: str) -> T:
        """Run ``work`` in a thread, once it is the turn of ``key``.

        Parameters
        ----------
        key
            Prefix of the API key; where there is none, what else names who asks.
        """
        async with self._slots.turn(key):
            return await anyio.to_thread.run_sync(work, limiter=self._threads)

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


class Downloads:
    """Bounds the files that one worker sends at the same time: a client may take them slowly.

    Parameters
    ----------
    most
        Files at the same time; one API key has half of them, and one token ``MOST_OF_TOKEN``.
    """

    def __init__(self, most: int) -> None:
        self._most = max(1, most)
        self._sent: Counter[str] = Counter()

    @contextmanager
    def place(self, *, key: str, token: str) -> Iterator[None]:
        """Take a place for one file.

        Raises
        ------
        ApiError
            ``overloaded``, with ``Retry-After``.
        """
        limits = {"": self._most, key: max(1, self._most // 2), token: MOST_OF_TOKEN}
        if any(self._sent[name] >= most for name, most in limits.items()):
            raise overloaded()
        self._sent.update(limits.keys())
        try:
            yield
        finally:
            self._sent.subtract(limits.keys())
            self._sent = +self._sent  # forgets whom it counts no more


def overloaded() -> ApiError:
    """Return the refusal of a request for which there is no place."""
    return ApiError(
        "overloaded",
        "too many requests are waiting; try again shortly",
        {},
        {"Retry-After": str(RETRY_AFTER_S)},
    )
