"""Reads the cases of one target under limits, in a process of its own; the first finding ends it.

:func:`run` starts the process and says what came of it. A finding is a case that raises what its
reader does not document, takes too long or too much memory, runs something, or ends the process.
"""

import json
import logging
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.targets import COPIES, TARGETS, Target

SECONDS = 10.0
"""CPU time of one case; one that takes more hangs. Of a case that waits, six times as much."""
FORBIDDEN = frozenset(
    (
        "ctypes.dlopen", "os.exec", "os.fork", "os.mkdir", "os.posix_spawn", "os.remove",
        "os.rename", "os.system", "pickle.find_class", "shutil.rmtree", "socket.connect",
        "subprocess.Popen",
    )
)  # fmt: skip
"""Audit events that no reader of bytes has a reason for."""

_ROOT = Path(__file__).resolve().parents[2]
_ENVIRONMENT = {
    # Threads and their arenas reserve address space that no case has asked for.
    **dict.fromkeys(("MALLOC_ARENA_MAX", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1"),
    "PYTHONHASHSEED": "0",
}
_VARYING = re.compile(r"[0-9a-f]{8,}|[0-9]+|'[^']*'|\"[^\"]*\"|b'.*'")


@dataclass
class Tally:
    """What came of the cases of one target; ``case`` and ``finding`` are of the last one."""

    outcomes: Counter[str] = field(default_factory=Counter)
    reasons: set[str] = field(default_factory=set)
    slowest_ms: float = 0.0
    peak_mib: float = 0.0
    case: int = -1
    finding: str | None = None


class Executed(BaseException):
    """A reader did what no reader does: ran something, or touched a file that is not its own."""


class Reader:
    """Reads cases one by one under the limits of a target."""

    def __init__(self, target: Target, tally: Tally) -> None:
        self._target, self._tally, self._watching = target, tally, False
        sys.addaudithook(self._watch)

    def _watch(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self._watching and event in FORBIDDEN:
            raise Executed(event)

    def read(self, data: bytes) -> None:
        """Read one case, and note what came of it."""
        tally, most = self._tally, self._target.memory_for(len(data))
        # The peak begins again at what is resident now: making the case may have taken more.
        Path("/proc/self/clear_refs").write_text("5")
        before, began = memory("VmRSS"), time.process_time()
        # Twice what the reader may take: what is reserved and never touched costs nothing.
        limit_to(memory("VmSize") + 2 * most + len(data))
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.setitimer(signal.ITIMER_REAL, 6 * SECONDS)
        self._watching = True
        try:
            self._target.read(data)
            tally.outcomes["accepted"] += 1
        except self._target.refusals as error:
            tally.outcomes["refused"] += 1
            tally.reasons.add(_VARYING.sub("#", str(error))[:120])
            if caused_by_memory(error):
                tally.finding = f"memory: ran out: {error}"
        except BaseException as error:
            tally.finding = "".join(traceback.format_exception(error, limit=-12))
        finally:
            self._watching = False
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
            limit_to(resource.RLIM_INFINITY)
        taken = max(0, memory("VmHWM") - before)
        tally.slowest_ms = max(tally.slowest_ms, 1e3 * (time.process_time() - began))
        tally.peak_mib = max(tally.peak_mib, taken / 2**20)
        if taken > most and tally.finding is None:
            limit = f"{self._target.memory_mib} MiB and {COPIES} times the input"
            tally.finding = f"memory: above {limit}"


def memory(name: str) -> int:
    """Bytes by a line of ``/proc/self/status``: ``VmHWM`` is the peak of what was resident."""
    text = Path("/proc/self/status").read_text()
    return int(re.findall(rf"^{name}:\s+(\d+) kB", text, re.MULTILINE)[0]) * 1024


def limit_to(most: int) -> None:
    """Bound the address space."""
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def caused_by_memory(error: BaseException | None) -> bool:
    """Whether memory ran out, even where the reader then said something else."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def cases_of(name: str, folder: Path, *, seed: int, regressions: bool) -> tuple[Target, Any]:
    """Return a target, and the function that makes its n-th case."""
    target = TARGETS[name](folder)
    if regressions:
        return target, lambda number: target.regressions[number]()
    return target, lambda number: target.make(Random(f"{seed}/{name}/{number}"))


def read_all(name: str, folder: Path, seed: int, cases: int, minutes: float, first: int) -> Tally:
    """Read cases, or for some minutes, in this process. No cases: what was found once."""
    regressions = not cases and not minutes
    tally = Tally()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        target, case = cases_of(name, folder, seed=seed, regressions=regressions)
        case(0)  # imports what is imported late
    # A reader that warns of hostile input floods a log, and the suite takes warnings as errors.
    warnings.simplefilter("error")
    logging.disable(logging.CRITICAL)
    reader, end = Reader(target, tally), time.monotonic() + 60 * minutes
    stop = first + (len(target.regressions) if regressions else cases)
    number = first
    while tally.finding is None and (time.monotonic() < end if minutes else number < stop):
        tally.case = number
        data = case(number)
        (folder / "case").write_bytes(data)
        (folder / "number").write_text(str(number))
        reader.read(data)
        number += 1
    return tally


def run(
    name: str, folder: Path, *, seed: int = 0, cases: int = 0, minutes: float = 0.0, first: int = 0
) -> Tally:
    """Read in a process of its own, and outlive its end; the case of a finding stays in `folder`.

    Parameters
    ----------
    name
        Of the target.
    folder
        For the files of the readers, and the last case.
    cases, minutes
        How many cases, or how long; neither: what was found once (``Target.regressions``).
    """
    folder.mkdir(parents=True, exist_ok=True)
    arguments = [name, str(folder.resolve()), str(seed), str(cases), str(minutes), str(first)]
    with tempfile.TemporaryFile() as said:
        done = subprocess.run(
            [sys.executable, "-m", "tests.fuzz.reading", *arguments],
            cwd=_ROOT,
            env=os.environ | _ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=said,
            check=False,
        )
        said.seek(0)
        words = said.read()[-4000:].decode("utf-8", "replace")
    if done.returncode == 0:
        values = json.loads(done.stdout)
        return Tally(Counter(values.pop("outcomes")), set(values.pop("reasons")), **values)
    number = folder / "number"
    if not number.exists():
        raise RuntimeError(f"the process of {name} failed before its first case:\n{words}")
    code = done.returncode
    death = f"exit status {code}" if code > 0 else signal.Signals(-code).name
    death = f"hang: {death}" if death in ("SIGPROF", "SIGALRM") else f"crash: {death}"
    return Tally(case=int(number.read_text()), finding=f"{death}\n{words}")


if __name__ == "__main__":
    of, into, *numbers = sys.argv[1:]
    SECONDS = float(os.environ.get("FUZZ_SECONDS", SECONDS))
    read = read_all(
        of, Path(into), int(numbers[0]), int(numbers[1]), float(numbers[2]), int(numbers[3])
    )
    print(json.dumps({**vars(read), "reasons": sorted(read.reasons)}))
