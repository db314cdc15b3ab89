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
_CHUNK_BYTES = 4096
_REMEDY = "run it by hand, as the user of the service, and mend it"


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
