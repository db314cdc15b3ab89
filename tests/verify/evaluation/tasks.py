"""What workers are given to do: a module that they import without what the tests need."""

import os
from pathlib import Path

from tests.patience import wait_until
from verify.evaluation import backends


def add(shared: int, item: int) -> int:
    return shared + item


def process(shared: tuple[Path, int], item: object) -> int:
    """Process of a task, once so many processes have begun one."""
    folder, processes = shared
    (folder / str(os.getpid())).touch()
    wait_until(lambda: len(list(folder.iterdir())) >= processes, what="the other processes")
    return os.getpid()


def kept_open() -> int:
    return len(backends._LAST)


def die(shared: object, item: object) -> None:
    os._exit(1)
