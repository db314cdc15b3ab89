"""Threads that share work with the calling one.

A call of a few milliseconds is over before the scheduler would have moved a woken thread away from
the processor that woke it: on a virtual machine, whose sleeping processors look busy, both then
share one for several milliseconds. So each helper is sent to a processor of its own before it
is woken, and may go anywhere once it runs. Helpers of one plain executor took 1.65 × as long for
1000 × 1000 points at n = 128 and m = 2 on two quiet processors.
"""

import ctypes
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from typing import TypeVar

_Item = TypeVar("_Item")

_MOST_IDLE = 64


class _Helper:
    """A thread that sleeps between calls."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="veilface-distances")
        self._thread = self._pool.submit(threading.get_native_id).result()

    def start(self, work: Callable[[], None], processor: int | None) -> "Future[None]":
        """Do the work, and begin on a processor."""
        if processor is None:
            return self._pool.submit(work)
        allowed = os.sched_getaffinity(0)
        _move(self._thread, {processor})

        def freely() -> None:
            _move(0, allowed)
            work()

        return self._pool.submit(freely)

    def leave(self) -> None:
        """Wait for the next call, or end where enough helpers do."""
        if len(_idle) < _MOST_IDLE:
            _idle.append(self)
        else:
            self._pool.shutdown(wait=False)


_idle: list[_Helper] = []
# A child of a fork has none of the threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)


def share(function: Callable[[_Item], object], items: Sequence[_Item], threads: int) -> None:
    """Call a function with every item, on this thread and helpers; raise the first failure."""
    waiting = iter(items)
    failures: list[BaseException] = []

    def work() -> None:
        for item in waiting:
            try:
                function(item)
            except BaseException as failure:
                failures.append(failure)
            if failures:
                return

    places = _processors(min(threads, len(items)) - 1)
    helpers = [_helper() for _ in places]
    started = [helper.start(work, place) for helper, place in zip(helpers, places, strict=True)]
    # The calling thread works too: it holds a core already, and leaves the others the rest.
    work()
    for helper, future in zip(helpers, started, strict=True):
        # Who has not begun by now has nothing left to do.
        if not future.cancel():
            future.result()
        helper.leave()
    if failures:
        raise failures[0]


def _helper() -> _Helper:
    try:
        return _idle.pop()
    except IndexError:
        return _Helper()


def _processors(count: int) -> list[int | None]:
    """Processors for helpers: those after the caller's, of all that it may use."""
    if count < 1:
        return []
    here = _here()
    if here is None:
        return [None] * count
    others = sorted(os.sched_getaffinity(0) - {here}, key=lambda number: (number < here, number))
    turned = others or [here]
    return [turned[k % len(turned)] for k in range(count)]


def _here() -> int | None:
    """Processor that the caller runs on, where the system tells."""
    find = _finder()
    number = -1 if find is None else find()
    return None if number < 0 else number


@cache
def _finder() -> Callable[[], int] | None:
    if not hasattr(os, "sched_setaffinity"):
        return None
    return getattr(ctypes.PyDLL(None), "sched_getcpu", None)


def _move(thread: int, processors: set[int]) -> None:
    """Let a thread run on some processors only; a system may refuse."""
    with suppress(OSError):
        os.sched_setaffinity(thread, processors)
