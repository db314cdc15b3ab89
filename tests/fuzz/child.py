"""The process that reads the cases of one target, under limits, and says what came of each.

``runner`` starts it. Before a case its number and the time go to a file that the runner has mapped
too, so that it knows which one did not come back. Results go to the standard output, a line of
JSON each. The limits hold while a case is read, not while it is made.
"""

import faulthandler
import json
import logging
import os
import re
import resource
import struct
import sys
import time
import traceback
import warnings
from argparse import ArgumentParser
from mmap import mmap
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.targets import COPIES, Target, target_of

STATE = struct.Struct("<qd")
"""Number of the case that is being read, -1 between cases, and when it was begun."""
FORBIDDEN = (
    "ctypes.dlopen",
    "os.exec",
    "os.fork",
    "os.mkdir",
    "os.posix_spawn",
    "os.remove",
    "os.rename",
    "os.system",
    "pickle.find_class",
    "shutil.rmtree",
    "socket.connect",
    "subprocess.Popen",
)
"""Audit events that no reader of bytes has a reason for."""
LOOK_AFTER_S = 0.0005
"""A case that took less cannot have touched enough memory to matter."""

_ROOT = Path(__file__).resolve().parents[2]
_OURS = tuple(str(_ROOT / name) for name in ("api", "models", "templates", "tests", "verify"))
_VARYING = re.compile(r"[0-9a-f]{8,}|[0-9]+|'[^']*'|\"[^\"]*\"|b'.*'")


class Executed(BaseException):
    """A reader did what no reader does: ran something, or touched a file that is not its own."""


class _Watch:
    """Turns forbidden audit events into :class:`Executed` while a case is read."""

    def __init__(self) -> None:
        self.on = False
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.on and event in FORBIDDEN:
            raise Executed(event)


def resident(name: str) -> int:
    """A line of ``/proc/self/status``, such as ``VmHWM``, in bytes."""
    match = re.search(rf"^{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    assert match is not None
    return int(match[1]) * 1024


def caused_by_memory(error: BaseException | None) -> bool:
    """Whether memory ran out, even where the reader then said something else."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def place_of(error: BaseException) -> str:
    """Where in the project the error came from."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if one.filename.startswith(_OURS)]
    last = (own or frames)[-1]
    return f"{Path(last.filename).relative_to(_ROOT) if own else last.filename}:{last.lineno}"


def reason_of(error: BaseException) -> str:
    """The message without what varies: how many there are says how far the cases reach."""
    return _VARYING.sub("#", str(error))[:120]


class Reader:
    """Reads cases one by one, and says what came of each."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._watch = _Watch()
        self._page = os.sysconf("SC_PAGESIZE")
        self._statm = os.open("/proc/self/statm", os.O_RDONLY)
        self._peak = os.open("/proc/self/clear_refs", os.O_WRONLY)

    def outcome(self, data: bytes) -> dict[str, Any]:
        """Read one case."""
        # The peak begins again at what is resident now: making the case may have taken more.
        os.write(self._peak, b"5")
        reserved, before = (
            int(pages) * self._page for pages in os.pread(self._statm, 100, 0).split()[:2]
        )
        # Twice what the reader may take: what is reserved and never touched costs nothing.
        self._limit(reserved + 2 * self._target.memory_for(len(data)) + len(data))
        began, cpu = time.perf_counter(), time.process_time()
        result = self._attempt(data)
        self._limit(resource.RLIM_INFINITY)
        result["ms"] = (time.process_time() - cpu) * 1000
        if time.perf_counter() - began > LOOK_AFTER_S:
            result["peak"] = max(0, resident("VmHWM") - before)
            if result["peak"] > self._target.memory_for(len(data)):
                most = f"{self._target.memory_mib} MiB and {COPIES} times the input"
                result.setdefault("finding", f"memory: above {most}")
        return result

    @staticmethod
    def _limit(most: int) -> None:
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))

    def _attempt(self, data: bytes) -> dict[str, Any]:
        self._watch.on = True
        try:
            self._target.read(data)
        except self._target.refusals as error:
            self._watch.on = False
            kind, code = type(error).__name__, getattr(error, "code", None)
            result = {
                "outcome": kind if code is None else f"{kind} {code}",
                "reason": reason_of(error),
            }
            if caused_by_memory(error):
                result["finding"] = f"memory: ran out at {place_of(error)}"
            return result
        except BaseException as error:
            self._watch.on = False
            kind = "memory: " if caused_by_memory(error) else ""
            return {
                "outcome": type(error).__name__,
                "finding": f"{kind}{type(error).__name__} at {place_of(error)}: {reason_of(error)}",
                "trace": traceback.format_exc(limit=-12),
            }
        finally:
            self._watch.on = False
        return {"outcome": "accepted"}


def case_of(target: Target, name: str, seed: int, number: int, *, regression: bool) -> bytes:
    """One case: generated, or of those that were once findings."""
    if regression:
        return target.regressions[number]()
    return target.make(Random(f"{seed}/{name}/{number}"))


def read_all(name: str, seed: int, numbers: range, folder: Path, *, regression: bool) -> None:
    """Read the cases of some numbers under the limits of the target."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        target = target_of(name)(folder)
        case_of(target, name, seed, 0, regression=regression)  # imports what is imported late
    # A reader that warns of hostile input floods a log, and the suite takes warnings as errors.
    warnings.simplefilter("error")
    faulthandler.enable()
    logging.disable(logging.CRITICAL)
    reader = Reader(target)
    with (folder / "state").open("r+b") as file, mmap(file.fileno(), STATE.size) as state:
        for number in numbers:
            data = case_of(target, name, seed, number, regression=regression)
            STATE.pack_into(state, 0, number, time.monotonic())
            result = reader.outcome(data)
            STATE.pack_into(state, 0, -1, time.monotonic())
            line = json.dumps({"case": number, "size": len(data), **result})
            os.write(sys.stdout.fileno(), line.encode() + b"\n")


def main() -> None:
    """Read cases, or write one to a file."""
    parser = ArgumentParser()
    parser.add_argument("target")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--regression", action="store_true")
    parser.add_argument("--write", type=Path)
    chosen = parser.parse_args()
    if chosen.write is None:
        numbers = range(chosen.first, chosen.first + chosen.count)
        read_all(chosen.target, chosen.seed, numbers, chosen.folder, regression=chosen.regression)
    else:
        target = target_of(chosen.target)(chosen.folder)
        chosen.write.write_bytes(
            case_of(target, chosen.target, chosen.seed, chosen.first, regression=chosen.regression)
        )


if __name__ == "__main__":
    main()
