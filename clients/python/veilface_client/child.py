"""A command in a process of its own: no shell, bounded output, a time limit, data by pipe."""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import IO

from veilface_client.errors import LiftTimeout, LiftUnavailable

MOST_OUTPUT = 8 * 2**20
_GRACE_S = 1.0


@dataclass(frozen=True, repr=False)
class Finished:
    """What a command left."""

    status: int
    output: bytes
    errors: bytes


class Canceller:
    """Ends a command, with all that it started: from any thread, and also before it runs."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cancelled = False
        self._process: subprocess.Popen[bytes] | None = None

    def attach(self, process: "subprocess.Popen[bytes]") -> None:
        """Take a command; it ends at once if it was cancelled before."""
        with self._lock:
            self._process = process
            cancelled = self._cancelled
        if cancelled:
            self.cancel()

    def cancel(self) -> None:
        """End the command, if one runs."""
        with self._lock:
            self._cancelled = True
            if self._process is not None:
                _kill(self._process)

    def detach(self) -> None:
        """Its process id may soon be another's."""
        with self._lock:
            self._process = None


def run(
    argv: Callable[[Sequence[str]], Sequence[str]],
    blobs: Sequence[bytes],
    *,
    environment: Mapping[str, str],
    folder: str,
    limit_s: float,
    canceller: Canceller | None = None,
) -> Finished:
    """Run a command that reads ``blobs`` as files.

    Parameters
    ----------
    argv
        The command, given the names under which it finds the blobs: ``/dev/fd/N``, each the end
        of a pipe. So no blob is ever a file. Each can be read once, from its beginning.
    limit_s
        The longest that the call may take. The command and all that it started in its session
        are ended then, and in any case before the call returns.
    canceller
        What another thread ends it with.

    Raises
    ------
    LiftUnavailable
        It cannot be started, or this platform cannot hand pipes to it.
    LiftTimeout
        It was killed at its limit.
    """
    if os.name != "posix":
        raise LiftUnavailable(
            "this platform cannot hand photos to another process without a file; call "
            "`veilface lift` on the files yourself"
        )
    deadline = time.monotonic() + limit_s
    # Only the child may hold the ends that are read: then a child that dies breaks the pipe.
    with contextlib.ExitStack() as read, contextlib.ExitStack() as written:
        pipes: list[tuple[int, int]] = []
        try:
            for _ in blobs:
                pipes.append(os.pipe())
                read.callback(os.close, pipes[-1][0])
                written.callback(os.close, pipes[-1][1])
            readable = [end for end, _ in pipes]
            process = subprocess.Popen(  # noqa: S603 - an explicit argv, no shell
                list(argv([f"/dev/fd/{end}" for end in readable])),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                pass_fds=readable,
                env=dict(environment),
                cwd=folder,
                start_new_session=True,
            )
        except OSError as error:
            raise LiftUnavailable(f"the command cannot be started: {error.strerror}") from None
        written.pop_all()
    attended = _attend(
        process, [end for _, end in pipes], blobs, deadline, canceller or Canceller()
    )
    if attended is None:
        raise LiftTimeout(f"it took longer than {limit_s:g} s")
    return attended


def _attend(
    process: "subprocess.Popen[bytes]",
    ends: Sequence[int],
    blobs: Sequence[bytes],
    deadline: float,
    canceller: Canceller,
) -> Finished | None:
    """Feed a process, collect what it says, and end it; None: its time was over."""
    assert process.stdout is not None  # noqa: S101 - it was asked for
    assert process.stderr is not None  # noqa: S101
    said: dict[str, bytes] = {}

    def collect(name: str, stream: IO[bytes]) -> None:
        with stream:
            said[name] = stream.read(MOST_OUTPUT)
            if stream.read(1):
                canceller.cancel()

    jobs = [
        partial(collect, "output", process.stdout),
        partial(collect, "errors", process.stderr),
        *(partial(_feed, end, blob) for end, blob in zip(ends, blobs, strict=True)),
    ]
    closes: list[Callable[[], None]] = [
        process.stdout.close,
        process.stderr.close,
        *(partial(os.close, end) for end in ends),
    ]
    threads: list[threading.Thread] = []
    try:
        canceller.attach(process)
        for job in jobs:
            thread = threading.Thread(target=job, daemon=True)
            thread.start()
            threads.append(thread)
        # Its output ends when the last process that holds it ends, the command itself or another.
        _join(threads, deadline)
        if any(thread.is_alive() for thread in threads):
            return None
        status = process.wait(timeout=max(0.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        return None
    finally:
        # Also after an end in order: what the command started may still run.
        _kill(process)
        canceller.detach()
        process.wait()
        # A thread closes what it reads or writes; those that never started do not.
        for close in closes[len(threads) :]:
            close()
        # A process that left the session lives on, and its pipes with it: wait for no such one.
        _join(threads, time.monotonic() + _GRACE_S)
    return Finished(status, said["output"], said["errors"])


def _join(threads: Sequence[threading.Thread], deadline: float) -> None:
    for thread in threads:
        thread.join(timeout=max(0.0, deadline - time.monotonic()))


def _feed(end: int, blob: bytes) -> None:
    # A child that ends before it has read everything says why on stderr.
    with contextlib.suppress(BrokenPipeError), open(end, "wb", buffering=0) as file:
        rest = memoryview(blob)
        while rest:
            rest = rest[file.write(rest) or 0 :]


def _kill(process: "subprocess.Popen[bytes]") -> None:
    # Nobody is left, or on macOS: only one that has ended and was not waited for.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
