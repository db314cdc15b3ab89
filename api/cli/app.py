"""All commands, put together. The module of a command is imported when the command is run.

So ``veilface --help`` is there at once, and ``veilface lift``, which a client may call for each
probe, and the workers of ``veilface serve`` do not import what the audit needs.
"""

import signal
from importlib import import_module
from typing import Annotated, Any

import typer
import typer.main
from typer.core import TyperCommand

from api.cli.console import say
from api.cli.errors import Commands

COMMANDS = {
    "demo": "Enroll, verify and erase people through the real service, in under a minute.",
    "setup": "Prepare a service from a model pack and folders of photos, and judge it.",
    "serve": "Start the REST service.",
    "enroll": "Enroll a person from photos, or replace their enrollment; or enroll many with "
    "--from.",
    "verify": "Check whether photos show a person; exit status 0 if accepted, 1 if rejected.",
    "lift": "Make a private template from photos on this machine, without any secret of the "
    "service.",
    "calibrate": "Calibrate on labelled people, and write the contract file.",
    "evaluate": "Evaluate face verification with private templates: the LFW / CFP / AgeDB "
    "protocol.",
    "evaluate liveness": "Evaluate the pack's liveness graphs on live and attack photos "
    "(ISO/IEC 30107-3).",
    "audit": "Attack private templates, and hold the results against your limits.",
    "decoys": "Make the decoys that hide an embedding inside its private template.",
    "keys": "Create and revoke API keys; rotate keys; verify erasure receipts.",
    "models": "Fetch and inspect model packs (the weights you supply).",
    "db": "Migrate, check and clean up the database; set up tenants.",
    "audit-log": "Verify, read and archive the audit log, a chain of lines.",
    "bench": "Time this machine, against the work that nothing can avoid.",
}
"""The first paragraph of each command's help."""

_MODULES = {
    "enroll": "subjects",
    "verify": "subjects",
    "audit-log": "audit_log",
    "evaluate liveness": "liveness",
}
_GROUPS = {"audit": ("fairface", "templates"), "bench": ("distances", "models")}
"""Commands that have a module of their own; those of other groups are in one."""

_LOOKS: dict[str, Any] = {"rich_markup_mode": "markdown", "pretty_exceptions_enable": False}


def load(name: str) -> Any:
    """Import a command, or all commands of a group."""
    around, group = typer.Typer(**_LOOKS), typer.Typer(no_args_is_help=True)
    parts = _GROUPS.get(name, ())
    for part in parts:
        group.command()(getattr(import_module(f"api.cli.{name}_{part}"), part))
    module = None if parts else import_module(f"api.cli.{_MODULES.get(name, name)}")
    if parts or hasattr(module, "app"):
        around.add_typer(getattr(module, "app", group), name=name, help=COMMANDS[name])
    else:
        around.command(name)(getattr(module, name.replace(" ", "_")))
    return typer.main.get_group(around).commands[name]


class Veilface(Commands):
    """The root command: it lists the commands without importing them."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = {name: TyperCommand(name, help=line) for name, line in COMMANDS.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the chosen command, and import it; a command of two words goes before one of one.

        So `evaluate liveness` is no data set of `evaluate`; a folder of that name is `./liveness`.
        """
        if (both := " ".join(args[:2])) in COMMANDS:
            args = [both, *args[2:]]
        name, command, rest = super().resolve_command(ctx, args)
        loaded = command and load(name)
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # as veilface/__main__.py leaves it
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return name, loaded, rest

    def get_params(self, ctx: Any) -> Any:
        """Give every flag a default: Typer imports pydantic to convert a value that is none."""
        params = super().get_params(ctx)
        for param in params:
            param.default = False
        return params


app = typer.Typer(
    name="veilface",
    cls=Veilface,
    no_args_is_help=True,
    help="Face authentication that never stores a face embedding.\n\n"
    "Start with `veilface demo`: it needs nothing. With your own weights: `setup`, then `serve`. "
    "`docs/cli.md` shows every command with an example.",
    **_LOOKS,
)


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        say(f"veilface {version('veilface')}")
        raise typer.Exit


@app.callback()
def _root(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    """Take the options that stand before a command."""


def main() -> None:
    """Run the command line on ``sys.argv``."""
    app()
