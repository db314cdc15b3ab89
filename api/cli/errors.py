"""What a person reads when a command fails: one sentence, and never a traceback.

A traceback shows local variables in some terminals, and exception texts of other libraries may
show what they were given. So only messages of our own exceptions are passed on.
"""

import traceback
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from api.cli.console import drop_unwritten, message
from templates.errors import VeilfaceError

FAILED, USAGE, NO_DECISION = 1, 2, 3
EXTRAS = {
    "evaluate": ("matplotlib", "numba", "pandas", "scipy"),
    "audit": ("matplotlib", "sklearn"),
    "cluster": ("distributed",),
    "postgres": ("psycopg",),
    "redis": ("redis",),
    "torch": ("torch",),
}
"""What each extra of pyproject.toml brings that the commands import."""


class CommandError(VeilfaceError):
    """A command cannot do what was asked; the message is the sentence that is shown."""


class UsageError(CommandError):
    """Options that contradict each other; the exit status is 2."""


class Commands(TyperGroup):
    """The root command: it turns every exception into a sentence and an exit status."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command; `verify` fails with a status that is no rejection."""
        try:
            return super().invoke(ctx)
        except (typer.Exit, typer.Abort, typer.TyperException):
            raise
        except Exception as error:
            message(f"error: {sentence(error)}")
            drop_unwritten()
            failed = NO_DECISION if ctx.invoked_subcommand == "verify" else FAILED
            raise typer.Exit(USAGE if isinstance(error, UsageError) else failed) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the chosen command; its name is known also where its import fails."""
        ctx.invoked_subcommand = args[0]
        return super().resolve_command(ctx, args)


def require_extra(extra: str) -> None:
    """Refuse at once what would otherwise fail after hours."""
    for package in EXTRAS[extra]:
        if find_spec(package) is None:
            raise CommandError(_missing(package, extra))


def _missing(package: str, extra: str) -> str:
    return f'{package} is not installed, and needed here: pip install "veilface[{extra}]"'


def sentence(error: Exception) -> str:
    """Say what is wrong, without a value that may be private."""
    # By name: the libraries of databases and models take seconds to import.
    kinds = {f"{kind.__module__}.{kind.__name__}" for kind in type(error).__mro__}
    if isinstance(error, VeilfaceError) or "models.errors.ModelError" in kinds:
        return str(error)
    if "sqlalchemy.exc.SQLAlchemyError" in kinds:
        return f"the database does not do what was asked ({type(error).__name__})"
    match error:
        case OSError():
            reason = error.strerror or type(error).__name__
            return f"{error.filename}: {reason}" if error.filename else reason
        case MemoryError():
            return "not enough memory: give fewer photos, or use a machine with more"
        case ModuleNotFoundError(name=str(module)):
            package = module.partition(".")[0]
            for extra, packages in EXTRAS.items():
                if package in packages:
                    return _missing(package, extra)
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(last.filename).name}:{last.lineno}"
    return f"a defect of veilface ({type(error).__name__} at {place}): please report it"
