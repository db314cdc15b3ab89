"""Runs a target's cases in child processes, and outlives what they do."""

import json
import os
import resource
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from mmap import mmap
from pathlib import Path
from typing import Any

from tests.fuzz.child import STATE

SECONDS = 10.0
"""CPU time of one case; one that takes more hangs."""
MAKING_SECONDS = 120.0
"""Wall time to start a child, or to make a case; more is a fault of the maker, not of a reader."""
PATIENCE = 6
"""Times as much of wall time for a case that waits, or runs on a busy machine."""
CASES_OF_A_CHILD = 50_000
"""Then another child goes on: what one case leaves behind does not add up for ever."""
SAVED_OF_A_KIND = 3

_ROOT = Path(__file__).resolve().parents[2]
_ENVIRONMENT = {
    **os.environ,
    # Threads and their arenas reserve address space that no case has asked for.
    "MALLOC_ARENA_MAX": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "PYTHONHASHSEED": "0",
}


@dataclass
class Tally:
    """What came of the cases of one target."""

    target: str
    outcomes: Counter[str] = field(default_factory=Counter)
    findings: Counter[str] = field(default_factory=Counter)
    reasons: set[tuple[str, str]] = field(default_factory=set)
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    slowest_ms: float = 0.0
    peak: int = 0
    largest: int = 0

    @property
    def cases(self) -> int:
        """How many were read to their end, or ended the process."""
        return self.outcomes.total()


class Runner:
    """Reads the cases of one target until they, or the time, are over.

    Parameters
    ----------
    target
        Its name.
    seed
        Cases are a function of the seed, the target and their number.
    out
        Where the inputs of findings go; None keeps them nowhere.
    """

    def __init__(self, target: str, *, seed: int = 0, out: Path | None = None) -> None:
        self.tally = Tally(target)
        self._target = target
        self._seed = seed
        self._out = out

    def run(
        self,
        *,
        first: int = 0,
        cases: int | None = None,
        seconds: float | None = None,
        regression: bool = False,
    ) -> Tally:
        """Read ``cases`` cases from ``first`` on, or what ``seconds`` allow.

        ``regression`` takes the inputs of earlier findings instead of generated ones.
        """
        began, cpu = time.monotonic(), _cpu_of_children()
        deadline = None if seconds is None else began + seconds
        stop = None if cases is None else first + cases
        number = first
        while (stop is None or number < stop) and (deadline is None or time.monotonic() < deadline):
            most = CASES_OF_A_CHILD if stop is None else min(CASES_OF_A_CHILD, stop - number)
            number = self._child(number, most, deadline, regression=regression)
        self.tally.seconds += time.monotonic() - began
        self.tally.cpu_seconds += _cpu_of_children() - cpu
        return self.tally

    def _child(self, first: int, count: int, deadline: float | None, *, regression: bool) -> int:
        """Run one child; return the number of the case to go on with."""
        with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
            folder = Path(name)
            (folder / "state").write_bytes(STATE.pack(-1, time.monotonic()))
            numbers = ["--first", str(first), "--count", str(count)]
            with (
                (folder / "stderr").open("w+b") as stderr,
                (folder / "state").open("r+b") as file,
                mmap(file.fileno(), STATE.size) as state,
                subprocess.Popen(
                    self._command(folder, *numbers, regression=regression),
                    cwd=_ROOT,
                    env=_ENVIRONMENT,
                    stdout=subprocess.PIPE,
                    stderr=stderr,
                ) as process,
            ):
                done, hung = self._follow(process, state, first, deadline, regression=regression)
                number, _ = STATE.unpack(state)
                if process.returncode == 0 or (
                    process.returncode == -signal.SIGKILL and not hung and done[1]
                ):
                    return done[0]
                stderr.seek(0)
                said = stderr.read()[-4000:].decode("utf-8", "replace")
            if number < 0:
                raise RuntimeError(f"the child of {self._target} failed between cases:\n{said}")
            what = f"hang: more than {SECONDS:g} s" if hung else _death(process.returncode)
            self._count(
                {"case": number, "outcome": what, "finding": what, "trace": said},
                regression=regression,
            )
            return int(number) + 1

    def _follow(
        self,
        process: "subprocess.Popen[bytes]",
        state: mmap,
        first: int,
        deadline: float | None,
        *,
        regression: bool,
    ) -> tuple[tuple[int, bool], bool]:
        """Count until the child ends. Return (next case, whether time is up), whether it hung."""
        assert process.stdout is not None
        following, over, hung, rest = first, False, False, b""
        stopwatch = _Stopwatch(process.pid)
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            while True:
                if selector.select(0.1):
                    read = os.read(process.stdout.fileno(), 2**16)
                    if not read:
                        break
                    *lines, rest = (rest + read).split(b"\n")
                    for line in lines:
                        result = json.loads(line)
                        self._count(result, regression=regression)
                        following = result["case"] + 1
                if not (over or hung):
                    hung = stopwatch.over(*STATE.unpack(state))
                    over = deadline is not None and time.monotonic() > deadline
                    if hung or over:
                        process.kill()
        process.wait()
        return (following, over), hung

    def _count(self, result: dict[str, Any], *, regression: bool) -> None:
        tally = self.tally
        tally.outcomes[result["outcome"]] += 1
        tally.slowest_ms = max(tally.slowest_ms, result.get("ms", 0.0))
        tally.peak = max(tally.peak, result.get("peak", 0))
        tally.largest = max(tally.largest, result.get("size", 0))
        if "reason" in result:
            tally.reasons.add((result["outcome"], result["reason"]))
        if "finding" in result:
            tally.findings[result["finding"]] += 1
            if tally.findings[result["finding"]] <= SAVED_OF_A_KIND:
                self._save(result, regression=regression)

    def _save(self, result: dict[str, Any], *, regression: bool) -> None:
        """Write the input, made again in a process of its own, and what was seen."""
        if self._out is None:
            return
        self._out.mkdir(parents=True, exist_ok=True)
        stem = (
            self._out
            / f"{self._target}-{'regression' if regression else self._seed}-{result['case']}"
        )
        stem.with_suffix(".json").write_text(json.dumps(result, indent=1), encoding="utf-8")
        with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
            write = [
                "--first",
                str(result["case"]),
                "--write",
                str(stem.with_suffix(".bin").resolve()),
            ]
            command = self._command(Path(name), *write, regression=regression)
            subprocess.run(command, cwd=_ROOT, env=_ENVIRONMENT, check=True)

    def _command(self, folder: Path, *options: str, regression: bool) -> list[str]:
        module = [sys.executable, "-m", "tests.fuzz.child", self._target, str(folder)]
        return [
            *module,
            "--seed",
            str(self._seed),
            *options,
            *(["--regression"] if regression else []),
        ]


class _Stopwatch:
    """Tells whether a process takes too long for a case.

    Parameters
    ----------
    pid
        Of the process.
    """

    def __init__(self, pid: int) -> None:
        self._stat = Path(f"/proc/{pid}/stat")
        self._ticks = os.sysconf("SC_CLK_TCK")
        self._seen = (-1, 0.0)
        self._cpu = 0.0

    def over(self, number: int, begun: float) -> bool:
        """Whether case ``number``, which was begun then, takes too long by now."""
        # Twice the same: the child may be writing it, which passes through zeros.
        if (number, begun) != self._seen:
            self._seen, self._cpu = (number, begun), self._cpu_now()
            return False
        taken = time.monotonic() - begun
        if number < 0:
            return taken > MAKING_SECONDS
        if taken <= SECONDS:
            return False
        return taken > PATIENCE * SECONDS or self._cpu_now() - self._cpu > SECONDS

    def _cpu_now(self) -> float:
        # The name of the process, in brackets, may hold spaces.
        fields = self._stat.read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / self._ticks


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _death(code: int) -> str:
    if code < 0:
        return f"crash: {signal.Signals(-code).name}"
    return f"crash: exit status {code}"
