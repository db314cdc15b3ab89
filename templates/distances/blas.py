"""The matrix library's threads: one per tile where tiles run in threads of their own."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any

from threadpoolctl import OpenBLASController, ThreadpoolController

_lock = threading.Lock()
_users = 0
_limiter: Any = None
_available = 1


@cache
def _controller() -> ThreadpoolController:
    # Compiled code loads SciPy's library at its first product, which is too late to be held.
    import_module("scipy.linalg.cython_blas")
    return ThreadpoolController().select(user_api="blas")


def _limit() -> None:
    global _limiter, _available
    controller = _controller()
    counts = [library.num_threads for library in controller.lib_controllers]
    _available = max(counts, default=1)
    _take_control()
    _limiter = controller.limit(limits=1)


def _restore() -> None:
    _take_control()
    _limiter.restore_original_limits()
    _take_control()


def _take_control() -> None:
    """Let the calling thread set OpenBLAS's number of threads.

    threadpoolctl lets one thread do so, the first that tried, and ignores every other in silence.
    Here callers on any thread share one limit, under a lock.
    """
    OpenBLASController.clear_controlling_thread(force=True)


def _forget() -> None:
    """A child of a fork starts anew: the callers that its parent had are not in it."""
    global _lock, _users
    if _users:
        _restore()
    _lock, _users = threading.Lock(), 0


os.register_at_fork(after_in_child=_forget)


@contextmanager
def single_threaded() -> Iterator[int]:
    """Hold the library to one thread, and say how many it would have used.

    Products on several threads at once wait for each other, and a product may round differently
    on another number of threads. The setting is the process's: it is made by the first of several
    callers and undone by the last, whichever threads they are, so that none undoes another's.
    """
    global _users
    with _lock:
        if not _users:
            _limit()
        _users += 1
        available = _available
    try:
        yield available
    finally:
        with _lock:
            _users -= 1
            if not _users:
                _restore()
