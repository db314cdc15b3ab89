"""What a command found, and the one place that shows it: as text, or as JSON with ``--json``."""

import dataclasses
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import typer

from api.cli.console import message, say


@dataclass(frozen=True)
class Table:
    """A table for a person; every cell is shown as ``str`` writes it."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


@dataclass(frozen=True)
class Result:
    """What a command found.

    ``facts`` may hold paths, times, and objects with a method ``to_json``.
    """

    facts: Any  # what --json writes: a mapping, a list or a dataclass
    text: str | Sequence[str | Table] | None = None  # what a person reads; None: the facts
    error: str | None = None  # what is wrong, on stderr after either; the exit status is then 1
    status: int = 0  # exit status where nothing is wrong: 1 for a negative answer


def as_json(value: Any) -> str:
    """Write facts as JSON."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False, default=_plain)


def _plain(value: Any) -> Any:
    if hasattr(value, "to_json"):
        return value.to_json()
    if dataclasses.is_dataclass(value):
        return {part.name: getattr(value, part.name) for part in dataclasses.fields(value)}
    if isinstance(value, datetime):
        return value.isoformat(timespec="seconds")
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} is not written as JSON")


def present(result: Result, *, json: bool) -> None:
    """Show a result; raises :class:`typer.Exit` where the exit status is not 0."""
    if json:
        say(as_json(result.facts))
    else:
        text = shown_facts(result.facts) if result.text is None else result.text
        for part in [text] if isinstance(text, str) else text:
            say(part if isinstance(part, str) else _drawn(part))
    if result.error is not None:
        message(f"error: {result.error}")
    if status := result.status or int(result.error is not None):
        raise typer.Exit(status)


def shown_facts(facts: Any, name: str = "") -> Iterator[str | Table]:
    """Show facts: a line for each value, a table for each list of records."""
    value = json.loads(as_json(facts))
    if isinstance(value, dict):
        for part, inner in value.items():
            yield from shown_facts(inner, f"{name} {part.replace('_', ' ')}".strip())
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        columns = [column.replace("_", " ") for column in value[0]]
        yield Table(name, columns, [[_cell(cell) for cell in row.values()] for row in value])
    else:
        yield f"{name}: {_cell(value)}"


def _cell(value: Any) -> str:
    match value:
        case None | []:
            return "none"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case list():
            return ", ".join(map(_cell, value))
        case dict():
            return ", ".join(f"{name} {_cell(inner)}" for name, inner in value.items())
    return str(value)


def _drawn(table: Table) -> str:
    from rich.console import Console
    from rich.table import Table as Listing

    listing = Listing(title=table.title, title_justify="left", title_style="bold")
    for column in table.columns:
        listing.add_column(column, overflow="fold")
    for row in table.rows:
        listing.add_row(*map(str, row))
    # Where nobody looks at a terminal, tables are not squeezed to 80 columns.
    width = None if sys.stdout.isatty() else 160
    console = Console(file=sys.stdout, width=width, markup=False)
    with console.capture() as captured:
        console.print(listing)
    return captured.get().removesuffix("\n")
