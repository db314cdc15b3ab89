"""The C library's allocator, where it is glibc's."""

import ctypes
import platform

_M_ARENA_MAX = -8  # of malloc.h


def keep_few_arenas(most: int) -> bool:
    """Let all threads share a few arenas, at least two; return whether the C library does.

    glibc gives a new thread an arena of its own, up to eight for each processor. Threads of a
    server come and go, and what each has once used stays resident in its arena.
    """
    return _is_glibc() and bool(ctypes.CDLL(None).mallopt(_M_ARENA_MAX, max(2, most)))


def give_back() -> bool:
    """Give free memory back to the system; return whether the C library could."""
    return _is_glibc() and bool(ctypes.CDLL(None).malloc_trim(0))


def _is_glibc() -> bool:
    return platform.libc_ver()[0] == "glibc"
