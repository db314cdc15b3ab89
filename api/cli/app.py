"""All commands, put together. The modules of a command are imported when it is asked for.

So ``veilface lift``, which a client may call for each probe, and the workers of ``veilface serve``
do not import what the audit needs.
"""

import importlib
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Annotated, Any

import typer
import typer.main

from api.cli.console import say
from api.cli.errors import Commands

MODULES = {
    "demo": "demo",
    "serve": "serve",
    "enroll": "subjects",
    "verify": "subjects",
    "lift": "lift",
    "calibrate": "calibrate",
    "evaluate": "evaluate",
    "audit": "audit",
    "decoys": "decoys",
    "keys": "keys",
    "models": "models",
    "db": "db",
    "audit-log": "audit_log",
    "bench": "bench",
}
"""Module of each command, within ``api.cli``: with ``register`` or, for a group, ``app``."""

_LOOKS: dict[str, Any] = {
    "add_completion": False,
    "rich_markup_mode": "markdown",
    "pretty_exceptions_enable": False,
}


class OnDemand(Mapping[str, Any]):
    """The commands by name, each imported when it is looked up."""

    def __init__(self) -> None:
        self._found: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._found:
            module = importlib.import_module(f"api.cli.{MODULES[name]}")
            around = typer.Typer(**_LOOKS)
            if hasattr(module, "register"):
                module.register(around)
            else:
                around.add_typer(module.app, name=name)
            self._found[name] = typer.main.get_group(around).commands[name]
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(MODULES)

    def __len__(self) -> int:
        return len(MODULES)


class Veilface(Commands):
    """The root command."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = OnDemand()  # type: ignore[assignment]  # nothing adds to it


app = typer.Typer(
    name="veilface",
    cls=Veilface,
    no_args_is_help=True,
    help="Face authentication that never stores a face embedding.\n\n"
    "Start with `veilface demo`: it needs nothing. With your own weights: `decoys build`, then "
    "`calibrate`, then `serve`. `docs/cli.md` shows every command with an example.",
    **_LOOKS,
)


def _show_version(asked: bool) -> None:
    if asked:
        say(f"veilface {version('veilface')}")
        raise typer.Exit


@app.callback()
def _root(
    _version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_show_version,
            is_eager=True,
            help="Print the version and exit.",
        ),
    ] = False,
) -> None:
    """Take the options that stand before a command."""


def main() -> None:
    """Run the command line on ``sys.argv``."""
    app()
