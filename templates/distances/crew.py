"""Threads that share work with the calling one.

A call of a few milliseconds is over before the scheduler would have moved a woken thread away from
the processor that woke it: on a virtual machine, whose sleeping processors look busy, both then
share one for several milliseconds. So each helper is sent to a processor of its own before it
is woken, and may go anywhere once it runs. Helpers are kept for the next call.
"""

import ctypes
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from typing import TypeVar

_In = TypeVar("_In")
_Out = TypeVar("_Out")

_MOST_IDLE = 64


class _Helper:
    """A thread that sleeps between calls."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="veilface-crew")
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

    def end(self) -> None:
        self._pool.shutdown(wait=False)


_idle: list[_Helper] = []
# A child of a fork has none of the threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)


class Crew:
    """The calling thread and others, which share the items of a list."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._helpers: list[_Helper] = []

    def __enter__(self) -> "Crew":
        for _ in range(self.count - 1):
            try:
                self._helpers.append(_idle.pop())
            except IndexError:
                self._helpers.append(_Helper())
        return self

    def __exit__(self, *_: object) -> None:
        for helper in self._helpers:
            if len(_idle) < _MOST_IDLE:
                _idle.append(helper)
            else:
                helper.end()

    def map(self, function: Callable[[_In], _Out], items: Sequence[_In]) -> list[_Out]:
        """Return the results in order; the first failure ends the work and is raised."""
        waiting = iter(list(enumerate(items)))
        lock = threading.Lock()
        results: dict[int, _Out] = {}
        failures: list[BaseException] = []

        def work() -> None:
            while not failures:
                with lock:
                    number, item = next(waiting, (None, None))
                if number is None:
                    return
                try:
                    results[number] = function(item)  # type: ignore[arg-type]
                except BaseException as failure:
                    failures.append(failure)

        helpers = self._helpers[: max(0, len(items) - 1)]
        places = _processors(len(helpers))
        started = [helper.start(work, place) for helper, place in zip(helpers, places, strict=True)]
        # The calling thread works too: it holds a core already, and leaves the others the rest.
        work()
        for one in started:
            # Who has not begun by now has nothing left to do.
            if not one.cancel():
                one.result()
        if failures:
            raise failures[0]
        return [results[number] for number in range(len(items))]


def _processors(count: int) -> list[int | None]:
    """Processors for helpers: those after the caller's, of all that it may use."""
    here = _here()
    if here is None or not count:
        return [None] * count
    allowed = sorted(os.sched_getaffinity(0) - {here})
    if not allowed:
        return [here] * count
    later = [each for each in allowed if each > here]
    turned = later + allowed[: len(allowed) - len(later)]
    return [turned[k % len(turned)] for k in range(count)]


def _here() -> int | None:
    """Processor that the caller runs on, where the system tells."""
    find = _finder()
    found = -1 if find is None else find()
    return None if found < 0 else found


@cache
def _finder() -> Callable[[], int] | None:
    if not hasattr(os, "sched_setaffinity"):
        return None
    return getattr(ctypes.PyDLL(None), "sched_getcpu", None)


def _move(thread: int, processors: set[int]) -> None:
    """Let a thread run on some processors only; a system may refuse."""
    with suppress(OSError):
        os.sched_setaffinity(thread, processors)
