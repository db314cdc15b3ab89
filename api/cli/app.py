"""All commands, put together."""

import typer

from api.cli import (
    audit,
    bench,
    calibrate,
    db,
    decoys,
    demo,
    evaluate,
    keys,
    lift,
    models,
    serve,
    subjects,
)
from api.cli.errors import Commands

app = typer.Typer(
    name="veilface",
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Face authentication that stores no face descriptor.\n\n"
    "Start with `veilface demo`: it needs nothing. With your own weights: `decoys build`, then "
    "`calibrate`, then `serve`. `docs/cli.md` shows every command with an example.",
)
demo.register(app)
serve.register(app)
subjects.register(app)
lift.register(app)
calibrate.register(app)
evaluate.register(app)
app.add_typer(audit.app, name="audit")
app.add_typer(decoys.app, name="decoys")
app.add_typer(keys.app, name="keys")
app.add_typer(models.app, name="models")
app.add_typer(db.app, name="db")
app.add_typer(bench.app, name="bench")


def main() -> None:
    """Run the command line on ``sys.argv``."""
    app()
