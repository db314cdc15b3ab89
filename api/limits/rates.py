"""Rate limits: how many requests an API key and a client address may make in a time.

The library `limits` counts them by its sliding window: in this process, or in Redis where several
workers or hosts share the limits. While Redis fails, each worker counts for itself, so that an
outage of Redis neither stops the service nor opens it.

The limits keep one client from taking the service for itself. What ends guessing is the lockout of
a subject, which is kept in the database.
"""

import ipaddress
import logging
import math
import time
from typing import Any

import anyio
import limits
from limits.aio.storage import MemoryStorage, RedisStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter
from starlette.types import Scope

from api.http.errors import ApiError, StartError
from api.service.logging import log
from api.service.metrics import RATE_LIMITED, RATE_STORAGE_FAILURES
from api.settings import OFF, Settings

STORAGE_TIMEOUT_S = 0.5
"""Longest that a question to Redis may take, and so delay a request."""

RETRY_STORAGE_S = 5.0
"""Time between two attempts to reach a Redis that failed."""

CONNECTIONS = 16

CROWD = 10_000
"""Counters in this process from which on larger networks count as one client. The library looks
through all counters at a request: 10,000 take a millisecond."""


class RateLimits:
    """The limits in force, of one worker: most requests, as ``600/minute``, or ``off``.

    Workers count together where there is a ``redis_url``, which no message repeats: it may hold a
    password. ``prefix`` is what the names of all keys in Redis begin with.
    """

    def __init__(
        self, *, key: str, address: str, redis_url: str | None = None, prefix: str = "veilface"
    ) -> None:
        self._limits = {
            kind: limits.parse(text)
            for kind, text in (("key", key), ("address", address))
            if text != OFF
        }
        self._own_counters = MemoryStorage()
        self._own = SlidingWindowCounterRateLimiter(self._own_counters)
        self._redis = None if redis_url is None else _opened(redis_url, prefix)
        self._shared = SlidingWindowCounterRateLimiter(self._redis or self._own_counters)
        self._failed = False
        self._try_again_at = -math.inf

    @classmethod
    def open(cls, settings: Settings) -> "RateLimits":
        """Make them from the settings."""
        url = settings.rate_limit_storage
        return cls(
            key=settings.rate_limit_key,
            address=settings.rate_limit_address,
            redis_url=None if url == "memory://" else url,
        )

    async def count_address(self, scope: Scope) -> None:
        """Count a request by its client's address, before anything else is known of it."""
        client = scope.get("client")
        crowded = len(self._own_counters.storage) >= CROWD
        await self._count("address", address_of(client[0] if client else "", crowded=crowded))

    async def count_key(self, prefix: str) -> None:
        """Count a request by its API key, or the one that made its token."""
        await self._count("key", prefix)

    async def close(self) -> None:
        """Close the connections to Redis."""
        if self._redis is not None:
            bridge: Any = self._redis.bridge
            await bridge.storage.connection_pool.disconnect()

    async def _count(self, kind: str, identity: str) -> None:
        limit = self._limits.get(kind)
        if limit is None:
            return
        wait = await self._wait(limit, kind, identity)
        if wait is not None:
            RATE_LIMITED.labels(kind).inc()
            who = "with this API key" if kind == "key" else "from this address"
            raise ApiError(
                "rate_limited",
                f"too many requests {who}; send fewer, or ask the operator for a higher limit",
                {"limit": kind},
                {"Retry-After": str(max(1, math.ceil(wait)))},
            )

    async def _wait(self, limit: limits.RateLimitItem, *identity: str) -> float | None:
        """Count one request; return the seconds until the next may pass, None where it passes."""
        now = time.monotonic()
        if self._failed and now < self._try_again_at:
            return await _hit(self._own, limit, *identity)
        # One request tries a Redis that failed; those that come meanwhile do not wait for it.
        self._try_again_at = now + RETRY_STORAGE_S
        try:
            with anyio.fail_after(STORAGE_TIMEOUT_S):
                wait = await _hit(self._shared, limit, *identity)
        except (limits.errors.StorageError, OSError) as error:
            if not self._failed:
                RATE_STORAGE_FAILURES.inc()
                kind = type(error).__name__
                log("rate limit storage failed", severity=logging.WARNING, error_type=kind)
            self._failed = True
            return await _hit(self._own, limit, *identity)
        if self._failed:
            log("rate limit storage answers again")
        self._failed = False
        return wait


def _opened(url: str, prefix: str) -> RedisStorage:
    try:
        from redis.asyncio import BlockingConnectionPool
        from redis.asyncio.retry import Retry
        from redis.backoff import NoBackoff
    except ImportError:
        raise StartError(
            "rate_limit_storage names Redis, but its client is absent: install veilface[redis]"
        ) from None
    try:
        # A connection that Redis closed while it was idle is opened again: hence one retry.
        pool: Any = BlockingConnectionPool.from_url(
            url, max_connections=CONNECTIONS, retry=Retry(NoBackoff(), 1)
        )
        return RedisStorage(
            "redis://",
            wrap_exceptions=True,
            implementation="redispy",
            key_prefix=prefix,
            connection_pool=pool,
        )
    except (ValueError, limits.errors.ConfigurationError):
        raise StartError(
            "setting rate_limit_storage: this is not the URL of a Redis server"
        ) from None


async def _hit(
    limiter: SlidingWindowCounterRateLimiter, limit: limits.RateLimitItem, *identity: str
) -> float | None:
    if await limiter.hit(limit, *identity):
        return None
    window = await limiter.get_window_stats(limit, *identity)
    return window.reset_time - time.time()


def address_of(host: str, *, crowded: bool = False) -> str:
    """Name what is counted as one client: an IPv4 address, or the /64 network of an IPv6 address.

    A provider gives each customer a /64 at least: an attacker would not run out of addresses in
    it. In a crowd it is a /24 and a /48, of which one customer may have every /64. What is no
    address, as a proxy may pass it on, is one client, ``unknown``.
    """
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return "unknown"
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    if isinstance(address, ipaddress.IPv6Address):
        length = 48 if crowded else 64
        return str(ipaddress.IPv6Network((int(address), length), strict=False))
    return str(ipaddress.IPv4Network((int(address), 24), strict=False) if crowded else address)
