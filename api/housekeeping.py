"""What a worker does between requests: it removes records that have expired."""

import logging
import random

import anyio
import anyio.to_thread

from api.logging import log
from templates.store import TemplateStore

PURGE_WAIT_S = 0.25
"""Longest that emptying SQLite's log may make a request's write wait for readers."""


async def purge_regularly(store: TemplateStore, *, every_s: float) -> None:
    """Purge at once and then every ``every_s`` seconds, until it is cancelled.

    A failure is one log line: the next round tries again. Rounds vary by a tenth, so that workers
    that started together do not purge together.
    """
    # A thread of its own: requests in the default limiter do not delay it, nor it them.
    limiter = anyio.CapacityLimiter(1)
    while True:
        try:
            await anyio.to_thread.run_sync(lambda: store.purge(wait=PURGE_WAIT_S), limiter=limiter)
        except Exception as error:
            log("purge failed", severity=logging.WARNING, error_type=type(error).__name__)
        await anyio.sleep(every_s * random.uniform(0.9, 1.1))
