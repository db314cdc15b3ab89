"""Rate limits: how many requests an API key and a client address may make in a time.

They are counted with the library `limits`, by its sliding window: the count of the running window
plus the part of the last one that still counts. In the process by default; in Redis where several
workers or hosts share the limits. While Redis fails, each worker counts for itself, so that
neither does an outage of Redis stop the service, nor does it open it.

The limits keep one client from taking the service for himself. What ends guessing is the lockout
of a subject, which is kept in the database.
"""

import ipaddress
import logging
import math
import time
from collections.abc import Callable
from typing import Any, Protocol

import anyio
import limits
from limits.aio.storage import MemoryStorage, RedisStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter
from starlette.types import Scope

from api.http.errors import ApiError, StartError
from api.service.logging import log
from api.service.metrics import RATE_LIMITED, RATE_STORAGE_FAILURES
from api.settings import OFF, Settings

KEY_PREFIX = "veilface"
STORAGE_TIMEOUT_S = 0.5
"""Longest that one step of a question to Redis may take, and so delay a request."""

RETRY_STORAGE_S = 5.0
"""Time between two attempts to reach a Redis that failed."""

CONNECTIONS = 16
MAX_COUNTERS = 100_000
"""Counters that a process keeps for single clients, 21 MB; further clients share ``SHARES``."""

SHARES = 4096
SWEEP_S = 1.0


class ProcessCounters(MemoryStorage):
    """The library's counters in this process, swept once in a while and bounded.

    The library's own sweep looks at every counter at every request. And an attacker with many
    addresses makes as many counters as he likes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._next_sweep = 0.0

    async def incr(self, key: str, expiry: float, amount: int = 1) -> int:
        """Count, in the counter of this key or, where there are too many, in one that is shared."""
        now = time.time()
        if now >= self._next_sweep:
            self._next_sweep = now + SWEEP_S
            for old in [key for key, end in self.expirations.items() if end <= now]:
                await self.clear(old)
        if self.expirations.get(key, 0) <= now:
            await self.clear(key)
            self.expirations[key] = now + expiry
        self.storage[key] += amount
        return self.storage[key]

    async def decr(self, key: str, amount: int = 1) -> int:
        """Take back a count."""
        self.storage[key] = max(self.storage[key] - amount, 0)
        return self.storage[key]

    @property
    def full(self) -> bool:
        """Whether no client may get a counter of his own any more."""
        return len(self.expirations) >= MAX_COUNTERS


class Storage(Protocol):
    """Where requests are counted: in this process, or in Redis with this process to fall back on.

    ``hit`` counts one request and returns None, or the seconds until the next one may pass.
    """

    async def hit(self, limit: limits.RateLimitItem, kind: str, identity: str) -> float | None:
        """Count one request of this identity."""

    async def close(self) -> None:
        """Let go of connections."""


class InProcess:
    """Counts in this process alone."""

    def __init__(self) -> None:
        self._counters = ProcessCounters()
        self._limiter = SlidingWindowCounterRateLimiter(self._counters)

    async def hit(self, limit: limits.RateLimitItem, kind: str, identity: str) -> float | None:
        """Count one request of this identity."""
        if self._counters.full:
            # Python's hash of a text is keyed with a secret of the process.
            identity = f"share-{hash(identity) % SHARES}"
        return await _hit(self._limiter, limit, kind, identity)

    async def close(self) -> None:
        """Nothing is open."""


class InRedis:
    """Counts in Redis, and in this process while Redis fails.

    Parameters
    ----------
    url
        Of the Redis server. It may hold a password: no message repeats it.
    prefix
        What the names of all keys begin with.

    Raises
    ------
    StartError
        If the client library is absent, or the URL is none. A server that does not answer is an
        outage like a later one.
    """

    def __init__(
        self, url: str, *, prefix: str = KEY_PREFIX, clock: Callable[[], float] = time.monotonic
    ) -> None:
        try:
            from redis.asyncio import BlockingConnectionPool
            from redis.asyncio.retry import Retry
            from redis.backoff import NoBackoff
            from redis.exceptions import RedisError
        except ImportError:
            raise StartError(
                "rate_limit_storage names Redis, but its client is absent: install veilface[redis]"
            ) from None
        try:
            # A connection that Redis closed while it was idle is opened again: hence one retry.
            self._pool: Any = BlockingConnectionPool.from_url(
                url,
                max_connections=CONNECTIONS,
                timeout=STORAGE_TIMEOUT_S,
                socket_timeout=STORAGE_TIMEOUT_S,
                socket_connect_timeout=STORAGE_TIMEOUT_S,
                retry=Retry(NoBackoff(), 1),
            )
            pool: Any = self._pool
            storage = RedisStorage(
                "redis://", implementation="redispy", key_prefix=prefix, connection_pool=pool
            )
        except (ValueError, limits.errors.ConfigurationError):
            raise StartError(
                "setting rate_limit_storage: this is not the URL of a Redis server"
            ) from None
        self._limiter = SlidingWindowCounterRateLimiter(storage)
        # OSError and TimeoutError too: not all of them are wrapped by the client library.
        self._failures = (RedisError, OSError)
        self._instead = InProcess()
        self._clock = clock
        self._failed = False
        self._try_again_at = -math.inf

    async def hit(self, limit: limits.RateLimitItem, kind: str, identity: str) -> float | None:
        """Count one request of this identity."""
        now = self._clock()
        if self._failed and now < self._try_again_at:
            return await self._instead.hit(limit, kind, identity)
        # One request tries; those that come meanwhile do not wait for it.
        self._try_again_at = now + RETRY_STORAGE_S
        try:
            wait = await _hit(self._limiter, limit, kind, identity)
        except self._failures as error:
            if not self._failed:
                self._failed = True
                RATE_STORAGE_FAILURES.inc()
                log(
                    "rate limit storage failed",
                    severity=logging.WARNING,
                    error_type=type(error).__name__,
                )
            return await self._instead.hit(limit, kind, identity)
        if self._failed:
            self._failed = False
            log("rate limit storage answers again")
        return wait

    async def close(self) -> None:
        """Close the connections."""
        await self._pool.disconnect()


class RateLimits:
    """The limits in force, of one worker.

    Parameters
    ----------
    key, address
        Most requests of one API key and of one client address; None for no limit.
    storage
        Where they are counted.
    """

    def __init__(
        self,
        *,
        key: limits.RateLimitItem | None,
        address: limits.RateLimitItem | None,
        storage: Storage,
    ) -> None:
        self._limits = {"key": key, "address": address}
        self._storage = storage

    @classmethod
    def open(cls, settings: Settings) -> "RateLimits":
        """Make them from the settings.

        Raises
        ------
        StartError
            If the storage cannot be used.
        """
        url = settings.rate_limit_storage
        return cls(
            key=_parsed(settings.rate_limit_key),
            address=_parsed(settings.rate_limit_address),
            storage=InProcess() if url == "memory://" else InRedis(url),
        )

    async def count_address(self, scope: Scope) -> None:
        """Count a request by its client's address, before anything else is known of it.

        Raises
        ------
        ApiError
            ``rate_limited``, with ``Retry-After``.
        """
        client = scope.get("client")
        await self._count("address", address_of(client[0] if client else ""))

    async def count_key(self, prefix: str) -> None:
        """Count a request by the API key that was recognised, named by its prefix.

        Raises
        ------
        ApiError
            ``rate_limited``, with ``Retry-After``.
        """
        await self._count("key", prefix)

    async def close(self) -> None:
        """Let go of the storage."""
        await self._storage.close()

    async def _count(self, kind: str, identity: str) -> None:
        limit = self._limits[kind]
        if limit is None:
            return
        wait = await self._storage.hit(limit, kind, identity)
        if wait is not None:
            RATE_LIMITED.labels(kind).inc()
            who = "with this API key" if kind == "key" else "from this address"
            raise ApiError(
                "rate_limited",
                f"too many requests {who}; send fewer, or ask the operator for a higher limit",
                {"limit": kind},
                {"Retry-After": str(max(1, math.ceil(wait)))},
            )


def address_of(host: str) -> str:
    """Name what is counted as one client: an IPv4 address, or the /64 network of an IPv6 address.

    A provider gives each customer a /64 at least: an attacker would not run out of addresses in
    it. What is no address, as a proxy may pass it on, is one client, ``unknown``.
    """
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return "unknown"
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.IPv6Network((int(address) >> 64 << 64, 64)))
    return str(address)


def _parsed(text: str) -> limits.RateLimitItem | None:
    return None if text == OFF else limits.parse(text)


async def _hit(
    limiter: SlidingWindowCounterRateLimiter, limit: limits.RateLimitItem, kind: str, identity: str
) -> float | None:
    if await limiter.hit(limit, kind, identity):
        return None
    window = await limiter.get_window_stats(limit, kind, identity)
    if not window.remaining and window.reset_time <= time.time():
        # In the very first millisecond of a window, limits takes its end for its beginning.
        await anyio.sleep(0.002)
        window = await limiter.get_window_stats(limit, kind, identity)
    return window.reset_time - time.time()
