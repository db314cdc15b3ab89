"""Files of strangers are read in a process of their own, which may take little memory."""

import resource
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

from verify.datasets import DatasetError

T = TypeVar("T")
MEMORY_BYTES = 8 * 2**30
"""Four times the largest file that is read, beyond what the libraries of the process take."""


def isolated(read: Callable[[Path], T], file: Path) -> T:
    """Read a file in a process that may not take more than ``MEMORY_BYTES``.

    Raises
    ------
    DatasetError
        That of ``read``; or the process ran out of memory, or crashed.
    """
    with ProcessPoolExecutor(
        1, get_context("spawn"), initializer=_limit_memory, initargs=(MEMORY_BYTES,)
    ) as child:
        try:
            return child.submit(read, file).result()
        except (BrokenProcessPool, MemoryError):
            raise DatasetError(
                f"{file} is not readable: its reader crashed, or needed more than "
                f"{MEMORY_BYTES // 2**20} MiB of memory"
            ) from None


def _limit_memory(most: int) -> None:
    pages = Path("/proc/self/statm")
    if pages.exists():
        taken = int(pages.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + most, resource.RLIM_INFINITY))
