"""Where the command line speaks: results on stdout, everything else on stderr.

Where the reader has gone, as that of ``veilface verify … | true``, a command goes on without words:
its exit status is an answer too. Rich is imported where something is drawn: most commands fail, or
speak, without it.
"""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager

import typer

Advance = Callable[[int], None]


def message(text: str) -> None:
    """Say something to the person; it does not disturb a program that reads stdout."""
    _write(text, err=True)


def say(text: str) -> None:
    """Write one line of the result to stdout."""
    _write(text)


def say_lines(lines: Iterable[str]) -> None:
    """Write lines to stdout, until there are no more or the reader has gone."""
    try:
        for line in lines:
            typer.echo(line)
    except BrokenPipeError:
        drop_unwritten()


def _write(text: str, *, err: bool = False) -> None:
    try:
        typer.echo(text, err=err)
    except OSError as error:
        if not (err or isinstance(error, BrokenPipeError)):
            raise
        drop_unwritten()


def drop_unwritten() -> None:
    """Forget what could not be written: at its end Python would try again, and fail."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 photo``, ``2 photos``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def demo_notice(embedder_sha256: str, *, n: int) -> dict[str, str]:
    """Say so on stderr where the embedder is the demo model; the same as a part of JSON.

    ``n`` is its dimension: a model of another one is not compared, which takes a second.
    """
    # Imported here, since commands that touch no model shall not wait for its libraries.
    from models.demo import DEMO_DIMENSION, DEMO_NOTICE, is_demo_model

    if n != DEMO_DIMENSION or not is_demo_model(embedder_sha256):
        return {}
    message(f"note: {DEMO_NOTICE}")
    return {"notice": DEMO_NOTICE}


def progress(description: str, total: int | None) -> AbstractContextManager[Advance]:
    """Show on stderr how many of ``total`` things, such as photos, are done.

    The result is called with the number of things that were done since. For work that has no such
    unit there is :func:`share_done`.
    """
    return _bar(description, total, "MofNCompleteColumn")


def download(description: str, total: int | None) -> AbstractContextManager[Advance]:
    """Show on stderr how many of ``total`` bytes have come; the result is called with more."""
    return _bar(description, total, "DownloadColumn")


@contextmanager
def share_done(description: str) -> Iterator[Callable[[float], None]]:
    """Show per cent on stderr while the block runs; call the result with the share from 0 to 1."""
    before = 0.0
    with _bar(description, 1.0, "TaskProgressColumn") as advance:

        def report(share: float) -> None:
            nonlocal before
            advance(share - before)
            before = share

        yield report


@contextmanager
def _bar(description: str, total: float | None, amount: str) -> Iterator[Callable[[float], None]]:
    from rich import console, progress

    terminal = console.Console(stderr=True)
    with progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        getattr(progress, amount)(),
        progress.TimeRemainingColumn(),
        console=terminal,
        transient=not terminal.is_terminal,
    ) as bar:
        task = bar.add_task(description, total=total)
        yield lambda done: bar.advance(task, done)
