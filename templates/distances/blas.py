"""The threads of the matrix library: one for each product while products run side by side."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from threadpoolctl import OpenBLASController, ThreadpoolController

_lock = threading.Lock()
_limit: Any = None
_available = 1
_users = 0


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def single_threaded() -> Iterator[int]:
    """Hold the library to one thread, and give the number that it would have used.

    Products on several threads at once wait for each other, and a product may round differently
    on another number of threads. The setting is the process's: the first of several callers makes
    it and the last undoes it, whichever threads they are, so that none undoes another's. OpenBLAS
    obeys one thread only, so each caller takes control first (threadpoolctl 3.8).
    """
    global _users, _limit, _available
    with _lock:
        if not _users:
            libraries = _controller().lib_controllers
            _available = max((library.num_threads for library in libraries), default=1)
            OpenBLASController.clear_controlling_thread(force=True)
            _limit = _controller().limit(limits=1)
        _users += 1
        available = _available
    try:
        yield available
    finally:
        with _lock:
            _users -= 1
            if not _users:
                OpenBLASController.clear_controlling_thread(force=True)
                _limit.restore_original_limits()
                OpenBLASController.clear_controlling_thread(force=True)
