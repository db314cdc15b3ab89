"""What a worker does between requests: it removes what has expired, subjects and records."""

import logging
import random
from collections.abc import Callable

import anyio
import anyio.to_thread

from api.service.logging import log
from api.service.metrics import PURGE_FAILURES
from templates.store import TemplateStore
from templates.store.retention import Retention

EVERY_S = 600.0
"""Between two rounds."""


async def purge_regularly(
    store: TemplateStore, keep: Retention, on_failure: Callable[[Exception], None]
) -> None:
    """Purge at once and then every ``EVERY_S`` seconds, until it is cancelled.

    A failure is one log line: the next round tries again. Rounds vary by a tenth, so that workers
    that started together do not purge together.
    """

    def purge() -> None:
        # Before the rest: it is emptied from the log of the same round.
        try:
            if erased := store.erasures.erase_expired(keep):
                log("retention erased subjects", subjects=erased)
        finally:
            if not store.purge():
                log(
                    "a reader of the database keeps its write-ahead log, with what was removed: it "
                    "is emptied another time",
                    severity=logging.WARNING,
                )

    # A thread of its own: requests in the default limiter do not delay it, nor it them.
    limiter = anyio.CapacityLimiter(1)
    while True:
        try:
            await anyio.to_thread.run_sync(purge, limiter=limiter)
        except Exception as error:
            PURGE_FAILURES.inc()
            on_failure(error)
            log("purge failed", severity=logging.WARNING, error_type=type(error).__name__)
        await anyio.sleep(EVERY_S * random.uniform(0.9, 1.1))
