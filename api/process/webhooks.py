"""Delivers the events of the outbox to the operator's endpoint, signed, until it takes them.

Each worker looks for events. A claim keeps the others from sending the same one meanwhile; where
its worker dies, it lapses.
"""

import logging
import random
import time
from collections.abc import Sequence

import anyio
import anyio.to_thread
import httpx

from api.process.logging import log
from api.process.metrics import WEBHOOKS
from templates.keys.webhook_secret import signatures
from templates.store.outbox import Event, Outbox

PAUSE_S = 1.0
LONGEST_S = 10.0
"""Seconds that one delivery may take in all, however slowly the endpoint answers; less than
:data:`templates.store.outbox.LEASE`, so that no other worker sends the event meanwhile."""


async def deliver(outbox: Outbox, url: str, secrets: Sequence[bytes]) -> None:
    """Send what is due, for as long as the worker runs; a failure is one log line."""
    # A thread of its own: requests in the default limiter do not delay it, nor it them.
    limiter = anyio.CapacityLimiter(1)
    async with httpx.AsyncClient(timeout=LONGEST_S, follow_redirects=False) as http:
        while True:
            event = None
            try:
                event = await anyio.to_thread.run_sync(outbox.claim, limiter=limiter)
                if event is not None:
                    is_taken = await send(http, url, secrets, event)
                    conclude = outbox.taken if is_taken else outbox.postpone
                    await anyio.to_thread.run_sync(conclude, event, limiter=limiter)
            except Exception as error:
                # What was claimed is claimed again when the claim has lapsed.
                log("webhook failed", severity=logging.WARNING, error_type=type(error).__name__)
                event = None
            if event is None:
                await anyio.sleep(PAUSE_S * random.uniform(0.9, 1.1))


async def send(http: httpx.AsyncClient, url: str, secrets: Sequence[bytes], event: Event) -> bool:
    """Send an event once; return whether the endpoint has taken it, by a status of 2xx."""
    timestamp = int(time.time())
    headers = {
        "Content-Type": "application/json",
        "webhook-id": event.event_id,
        "webhook-timestamp": str(timestamp),
        "webhook-signature": signatures(secrets, event.event_id, timestamp, event.body),
    }
    status, error_type = None, None
    try:
        # Of the answer the status alone is read.
        with anyio.fail_after(LONGEST_S):
            async with http.stream(
                "POST", url, content=event.body.encode(), headers=headers
            ) as answer:
                status = answer.status_code
                if answer.is_success:
                    WEBHOOKS.labels("taken").inc()
                    return True
    except Exception as error:
        error_type = type(error).__name__
    WEBHOOKS.labels("failed").inc()
    log("webhook failed", severity=logging.WARNING, status=status, error_type=error_type)
    return False
