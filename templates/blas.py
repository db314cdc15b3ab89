"""The matrix library's threads: one per tile where tiles run in threads of their own."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any

from threadpoolctl import ThreadpoolController

_lock = threading.Lock()
_users = 0
_limiter: Any = None
_available = 1


@cache
def _controller() -> ThreadpoolController:
    # Compiled code loads SciPy's library at its first product, which is too late to be held.
    import_module("scipy.linalg.cython_blas")
    return ThreadpoolController().select(user_api="blas")


def _forget() -> None:
    """A child of a fork starts anew: the callers that its parent had are not in it."""
    global _lock, _users
    if _users and _limiter is not None:
        _limiter.restore_original_limits()
    _lock, _users = threading.Lock(), 0


os.register_at_fork(after_in_child=_forget)


@contextmanager
def single_threaded() -> Iterator[int]:
    """Hold the library to one thread, and say how many it would have used.

    A product's last bits depend on the number of threads, and products on several threads at once
    wait for each other. The setting is the process's: it is made by the first of several callers
    and undone by the last, so that none undoes another's.
    """
    global _users, _limiter, _available
    with _lock:
        if not _users:
            controller = _controller()
            counts = [library.num_threads for library in controller.lib_controllers]
            _available = max(counts, default=1)
            _limiter = controller.limit(limits=1)
        _users += 1
        available = _available
    try:
        yield available
    finally:
        with _lock:
            _users -= 1
            if not _users and _limiter is not None:
                _limiter.restore_original_limits()
