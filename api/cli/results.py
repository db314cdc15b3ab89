"""What a command found, and the one place that shows it: as text, or as JSON with ``--json``.

A command is a function from flags to a :class:`Result`. The decorator :func:`reports` gives it its
flags for settings and ``--json``, shows the result, and sets the exit status.
"""

import dataclasses
import inspect
import json
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import message, say
from api.cli.errors import UsageError
from api.cli.options import AsJson, shown_as, takes_settings


@dataclass(frozen=True)
class Table:
    """A table for a person; every cell is shown as ``str`` writes it."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


@dataclass(frozen=True)
class Result:
    """What a command found.

    Parameters
    ----------
    facts
        What ``--json`` writes: a mapping, a list or a dataclass. It may hold paths, times, and
        objects with a method ``to_json``.
    text
        What a person reads instead: lines and tables, in order.
    error
        What is wrong, on stderr after either; the exit status is then 1.
    status
        Exit status where nothing is wrong: 1 for a negative answer.
    """

    facts: Any
    text: str | Sequence[str | Table] = ()
    error: str | None = None
    status: int = 0


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
        for part in [result.text] if isinstance(result.text, str) else result.text:
            if isinstance(part, str):
                say(part)
            else:
                _show(part)
    if result.error is not None:
        message(f"error: {result.error}")
    if status := result.status or int(result.error is not None):
        raise typer.Exit(status)


def _show(table: Table) -> None:
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
    say(captured.get().removesuffix("\n"))


_AS_JSON = inspect.Parameter(
    "as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=AsJson
)


def reports(*settings: str) -> Callable[[Callable[..., Result]], Callable[..., None]]:
    """Give a command that returns a :class:`Result` flags for settings, and ``--json``."""

    def decorate(command: Callable[..., Result]) -> Callable[..., None]:
        inner = takes_settings(*settings)(command) if settings else command

        def run(*, as_json: bool, **given: Any) -> None:
            present(inner(**given), json=as_json)

        return shown_as(run, inner, _AS_JSON)

    return decorate


def _read_plan(ctx: typer.Context, file: Path | None) -> Path | None:
    """Take a plan's values as the defaults of the flags that it names."""
    if file is None:
        return None
    try:
        values: Mapping[str, Any] = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"--plan {file} cannot be read as TOML: {error}") from None
    names = {
        flag.lstrip("-").replace("-", "_"): str(parameter.name)
        for parameter in ctx.command.params
        for flag in (*parameter.opts, str(parameter.name))
        if "--plan" not in parameter.opts
    }
    chosen = {name.replace("-", "_"): value for name, value in values.items()}
    if unknown := sorted(chosen.keys() - names.keys()):
        raise UsageError(f"--plan {file} names no option of this command: {', '.join(unknown)}")
    values = {names[name]: value for name, value in chosen.items()}
    ctx.default_map = {**(ctx.default_map or {}), **values}
    return file


Plan = Annotated[
    Path | None,
    typer.Option(
        "--plan",
        is_eager=True,
        callback=_read_plan,
        help="A TOML file with options, named as their flags; flags that are given win.",
    ),
]
