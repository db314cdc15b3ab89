"""Whose turn it is to wait for SQLite's lock, over all processes.

SQLite polls its lock, ever less often, and a process that writes without a pause frees it for less
than a millisecond at a time: another one could wait until its timeout. So only one process waits
for the lock at a time. A process that has just written queues behind it.
"""

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

_POLL_S = 0.001


@contextlib.contextmanager
def next_in_line(database: Path, until: float) -> Iterator[None]:
    """Hold the turn, in an empty file ``…-turn`` beside the database.

    A process that does not get it by `until`, of :func:`time.monotonic`, or cannot use the file,
    goes on without: the turn spares others a wait and guards nothing.
    """
    # Not in the database's file: closing that would drop the locks that SQLite holds on it.
    file = database.with_name(f"{database.name}-turn")
    try:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(file, flags, 0o600)
    except OSError:
        yield
        return
    try:
        while not _try_lock(descriptor) and time.monotonic() < until:
            time.sleep(_POLL_S)
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # closing alone would not, after a fork
        os.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without such locks
        return True
    return True
