"""Where the command line speaks: results on stdout, everything else on stderr.

Where the reader has gone, as that of ``veilface verify … | true``, a command goes on without words:
its exit status is an answer too. Rich is imported where something is drawn: most commands fail, or
speak, without it.
"""

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

Advance = Callable[[int], None]

_WIDTH_OF_A_FILE = 160  # where nobody looks at a terminal, tables are not squeezed to 80 columns


def message(text: str) -> None:
    """Say something to the person; it does not disturb a program that reads stdout."""
    _write(text, err=True)


def emit(value: Mapping[str, Any] | Sequence[Any]) -> None:
    """Write one JSON value to stdout."""
    say(as_json_text(value))


def as_json_text(value: Mapping[str, Any] | Sequence[Any]) -> str:
    """Write one JSON value as :func:`emit` does."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)


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


def table(title: str, *columns: str) -> "Table":
    """Make an empty table; numbers are the caller's to align."""
    from rich.table import Table

    made = Table(title=title, title_justify="left", title_style="bold")
    for column in columns:
        made.add_column(column, overflow="fold")
    return made


def show(*tables: "Table") -> None:
    """Write tables to stdout."""
    for listing in tables:
        print_rich(listing)


def print_rich(listing: "Table") -> None:
    """Write a table to stdout; its cells are plain text, without markup."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else _WIDTH_OF_A_FILE
    console = Console(file=sys.stdout, width=width, markup=False)
    with console.capture() as captured:
        console.print(listing)
    say(captured.get().removesuffix("\n"))


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


@contextmanager
def progress(description: str, total: int | None) -> Iterator[Advance]:
    """Show a progress bar on stderr while the block runs; call the result with what was done.

    ``total`` counts things that a reader knows, such as photos. For work that has no such unit
    there is :func:`share_done`.
    """
    with _bar("MofNCompleteColumn") as bar:
        task = bar.add_task(description, total=total)
        yield lambda done: bar.advance(task, done)


@contextmanager
def share_done(description: str) -> Iterator[Callable[[float], None]]:
    """Show per cent on stderr while the block runs; call the result with the share from 0 to 1."""
    with _bar("TaskProgressColumn") as bar:
        task = bar.add_task(description, total=1.0)
        yield lambda share: bar.update(task, completed=share)


@contextmanager
def download(description: str) -> Iterator[Callable[[int | None], Advance]]:
    """Show bytes on stderr while the block runs; call the result with their number, if known."""
    with _bar("DownloadColumn") as bar:

        def begin(total: int | None) -> Advance:
            task = bar.add_task(description, total=total)
            return lambda done: bar.advance(task, done)

        yield begin


def _bar(amount: str) -> "Progress":
    from rich import console, progress

    terminal = console.Console(stderr=True)
    return progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        getattr(progress, amount)(),
        progress.TimeRemainingColumn(),
        console=terminal,
        transient=not terminal.is_terminal,
    )
