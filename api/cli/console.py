"""Where the command line speaks: results on stdout, everything else on stderr.

Where the reader has gone, as that of ``veilface verify … | true``, a command goes on without words:
its exit status is an answer too. Rich is imported where something is drawn: most commands fail, or
speak, without it.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from models.pack import PackInfo
    from templates.contract.document import Binding

Advance = Callable[[float], None]


def message(text: str) -> None:
    """Say something to the person; it does not disturb a program that reads stdout."""
    with contextlib.suppress(OSError):
        typer.echo(text, err=True)


def say(text: str) -> None:
    """Write one line of the result to stdout."""
    try:
        typer.echo(text)
    except BrokenPipeError:
        drop_unwritten()


def drop_unwritten() -> None:
    """Forget what could not be written: at its end Python would try again, and fail."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def demo_notice(made_by: "PackInfo | Binding") -> dict[str, str]:
    """Say so on stderr where the embedder is the demo model; the same as a part of JSON."""
    # Imported here, since commands that touch no model shall not wait for its libraries.
    from models.demo import DEMO_DIMENSION, DEMO_NOTICE, is_demo_model

    # A model of another dimension is not compared, which takes a second.
    if made_by.n != DEMO_DIMENSION or not is_demo_model(made_by.embedder_sha256):
        return {}
    message(f"note: {DEMO_NOTICE}")
    return {"notice": DEMO_NOTICE}


@contextmanager
def progress(description: str, total: float | None) -> Iterator[Advance]:
    """Show on stderr how much of ``total`` is done; call the result with what is done since."""
    from rich import console, progress

    terminal = console.Console(stderr=True)
    with progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.TaskProgressColumn(show_speed=True),
        progress.TimeRemainingColumn(),
        console=terminal,
        transient=not terminal.is_terminal,
    ) as bar:
        task = bar.add_task(description, total=total)
        yield lambda done: bar.advance(task, done)


@contextmanager
def share_done(description: str) -> Iterator[Callable[[float], None]]:
    """Show per cent on stderr while the block runs; call the result with the share from 0 to 1."""
    before = 0.0
    with progress(description, 1.0) as advance:

        def report(share: float) -> None:
            nonlocal before
            advance(share - before)
            before = share

        yield report
