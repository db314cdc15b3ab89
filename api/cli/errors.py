"""What a person reads when a command fails: one sentence, and never a traceback.

A traceback shows local variables in some terminals, and exception texts of other libraries may
show what they were given. So only messages of our own exceptions are passed on.
"""

import traceback
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from api.cli.console import message
from templates.errors import VeilfaceError

FAILED = 1
USAGE = 2
NO_DECISION = 3
_FAILED_STATUS = {"verify": NO_DECISION}  # where 1 is an answer


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
        except (typer.Exit, typer.Abort, typer.TyperException, BrokenPipeError):
            raise
        except Exception as error:
            message(f"error: {sentence(error)}")
            failed = _FAILED_STATUS.get(ctx.invoked_subcommand, FAILED)
            raise typer.Exit(USAGE if isinstance(error, UsageError) else failed) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the chosen command; its name is known also where its import fails."""
        ctx.invoked_subcommand = args[0]
        return super().resolve_command(ctx, args)


def sentence(error: Exception) -> str:
    """Say what is wrong, without a value that may be private."""
    # Imported here: the database's and the models' libraries take seconds, and most commands fail
    # without them, if at all.
    from sqlalchemy.exc import SQLAlchemyError

    from models.errors import ModelError

    match error:
        case VeilfaceError() | ModelError():
            return str(error)
        case SQLAlchemyError():
            return f"the database does not do what was asked ({type(error).__name__})"
        case OSError():
            reason = error.strerror or type(error).__name__
            return f"{error.filename}: {reason}" if error.filename else reason
        case MemoryError():
            return "not enough memory: give fewer photos, or use a machine with more"
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(last.filename).name}:{last.lineno}"
    return f"a defect of veilface ({type(error).__name__} at {place}): please report it"
