"""Readers that are broken on purpose, each in its own way: the runner must see it."""

import ctypes
import os
import time
from collections.abc import Callable
from pathlib import Path
from random import Random

from tests.fuzz.targets import Target


class Refused(Exception):
    """What the readers below document."""


def _faulty(fault: Callable[[], object]) -> Callable[[Path], Target]:
    """A reader that accepts short cases, refuses longer ones and has its fault at the fifth."""

    def make(rng: Random) -> bytes:
        return rng.choice((b"", b"long"))

    def target(folder: Path) -> Target:
        seen = []

        def read(data: bytes) -> None:
            seen.append(data)
            if len(seen) == 5:
                fault()
            if data:
                raise Refused("too long")

        return Target(read, (Refused,), make, 32)

    return target


def _compute() -> None:
    while True:
        pass


def _refuse_for_memory() -> None:
    try:
        bytearray(2**40)
    except MemoryError:
        raise Refused("damaged") from None


FAULTY: dict[str, Callable[[Path], Target]] = {
    "no fault": _faulty(lambda: None),
    "raises": _faulty(lambda: [].pop()),
    "waits": _faulty(lambda: time.sleep(3600)),
    "computes": _faulty(_compute),
    "crashes": _faulty(lambda: ctypes.string_at(0)),
    "leaves": _faulty(lambda: os._exit(3)),
    "takes memory": _faulty(lambda: len(bytearray(b"x") * (40 * 2**20))),
    "hides that memory ran out": _faulty(_refuse_for_memory),
    "runs a command": _faulty(lambda: os.system("true")),
}
