"""A worker under a supervisor, where there are several: what it waits for, and when it ends.

The supervisor (uvicorn's) starts a worker in place of one that died, and stops the service when
that one fails to start. So a worker that is started while the database is away waits for it; the
others, which run, answer ``store_unavailable`` meanwhile and need no restart either.

A worker whose supervisor was killed ends as if it had been told to. Else it would hold the port,
and a service that is started again could not listen.
"""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

import anyio

from api.http.errors import DatabaseAway
from api.service.logging import log
from templates.errors import StoreUnavailable

T = TypeVar("T")

RETRY_S = 1.0
LOOK_S = 1.0


def is_supervised() -> bool:
    """Whether a supervisor started this process."""
    return multiprocessing.parent_process() is not None


def supervisor_lives() -> bool:
    """Whether the supervisor runs."""
    parent = multiprocessing.parent_process()
    # Not the pipe that tells of its end: workers that were forked later hold its other end too.
    return parent is not None and parent.pid == os.getppid()


def open_patiently(open_it: Callable[[], T], told: threading.Event) -> T:
    """Open what a worker needs; under a supervisor, wait for a database that is away.

    The supervisor has opened all of it before it started a worker. A service that is started by
    hand does not wait: its operator shall read why.

    Parameters
    ----------
    open_it
        Tried every second.
    told
        Set when the worker is to stop.

    Raises
    ------
    DatabaseAway, StoreUnavailable
        Without a supervisor, or once the worker is to stop.
    """
    waiting = False
    while True:
        try:
            opened = open_it()
        except (DatabaseAway, StoreUnavailable) as error:
            if not is_supervised():
                raise
            if not waiting:
                log(
                    "the database is away: the worker waits for it",
                    severity=logging.ERROR,
                    pid=os.getpid(),
                    error_type=type(error).__name__,
                )
            waiting = True
            if told.wait(RETRY_S) or not supervisor_lives():
                raise
        else:
            return opened


async def end_with_supervisor() -> None:
    """Tell this process to stop once its supervisor is gone; looks every second."""
    while supervisor_lives():
        await anyio.sleep(LOOK_S)
    log("the supervisor is gone: the worker stops", severity=logging.ERROR, pid=os.getpid())
    signal.raise_signal(signal.SIGTERM)


@contextmanager
def told_to_stop(then: Callable[[], object]) -> Iterator[None]:
    """Call `then` when the signal to stop comes, before the server's own handler is called."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers: dict[int, Any] = {}

    def told(number: int, frame: FrameType | None) -> None:
        then()
        handlers[number](number, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        handler = signal.getsignal(number)
        if callable(handler):
            handlers[number] = handler
            signal.signal(number, told)
    try:
        yield
    finally:
        for told_number, handler in handlers.items():
            signal.signal(told_number, handler)
