"""Master keys that a command hands over: the hook for a key management service (KMS)."""

import contextlib
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Sequence
from typing import IO

from templates.errors import SealError
from templates.keys.key_file import keys_in

MAX_OUTPUT_BYTES = 64 * 1024
ASK_AGAIN_S = 10.0
"""Seconds between two runs of a key command that blobs under unknown keys ask for."""
_CHUNK_BYTES = 4096
_REMEDY = "run it by hand, as the user of the service, and mend it"


class KeyCommand:
    """A key command, when it was last run, and how that failed."""

    def __init__(self, argv: Sequence[str], timeout_s: float) -> None:
        self._argv = tuple(argv)
        self._timeout_s = timeout_s
        self._asked_at = 0.0
        self.failure: SealError | None = None
        self.source = f"the key command {self._argv[0] if self._argv else ''}"

    def ask(self) -> list[bytes]:
        """Run the command; :class:`SealError` where it fails."""
        try:
            return keys_of_command(self._argv, timeout_s=self._timeout_s)
        finally:
            self._asked_at = time.monotonic()

    def ask_again(self) -> list[bytes]:
        """Keys, or none where it was run just before, or failed: those in memory stay good."""
        if time.monotonic() - self._asked_at < ASK_AGAIN_S:
            return []
        self.failure = None
        try:
            return self.ask()
        except SealError as error:
            self.failure = error
            return []


def keys_of_command(argv: Sequence[str], *, timeout_s: float) -> list[bytes]:
    """Run a command and read the master keys that it writes, one base64 key on a line.

    No shell is between, so nothing in the arguments is expanded. What the command writes to its
    standard error goes nowhere: a client of a KMS may quote credentials there.

    Parameters
    ----------
    argv
        Program and arguments.
    timeout_s
        Seconds until the command, and whatever it started, is killed.

    Raises
    ------
    SealError
        If the command cannot be started, fails, takes too long or writes too much, or if what it
        writes is no list of good keys.
    """
    if not argv:
        raise SealError("the key command is empty: give a program and its arguments")
    source = f"the key command {argv[0]}"
    try:
        process = subprocess.Popen(  # noqa: S603 - the operator's own command, without a shell
            list(argv),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # so that what it starts can be killed with it
        )
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "an argument holds a zero byte"
        raise SealError(f"{source} cannot be started: {reason}; {_REMEDY}") from None
    deadline = time.monotonic() + timeout_s
    with process:
        try:
            assert process.stdout is not None  # noqa: S101 - a pipe, see above
            output = _read(process.stdout, source=source, deadline=deadline)
            status = process.wait(max(0.0, deadline - time.monotonic()))
        except BaseException as error:
            # It was not waited for yet, so the number is still its own.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            if isinstance(error, _TooSlow | subprocess.TimeoutExpired):
                raise SealError(
                    f"{source} did not finish within {timeout_s:g} seconds; {_REMEDY}"
                ) from None
            raise
    if status != 0:
        raise SealError(f"{source} failed with exit status {status}; {_REMEDY}")
    try:
        text = output.decode("ascii")
    except UnicodeDecodeError:
        raise SealError(
            f"{source} wrote something else than text: it must write one base64 key on each line"
        ) from None
    return keys_in(text, source=source)


class _TooSlow(Exception):
    """The deadline passed while the command still held its output open."""


def _read(pipe: IO[bytes], *, source: str, deadline: float) -> bytes:
    read = bytearray()
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        while selector.select(max(0.0, deadline - time.monotonic())):
            chunk = os.read(pipe.fileno(), _CHUNK_BYTES)
            if not chunk:
                return bytes(read)
            read += chunk
            if len(read) > MAX_OUTPUT_BYTES:
                raise SealError(
                    f"{source} wrote more than {MAX_OUTPUT_BYTES} bytes: it must write one base64 "
                    "key on each line, and nothing else"
                )
    raise _TooSlow
