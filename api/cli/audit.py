"""``veilface audit``: what an adversary learns from templates, held against limits."""

import typer

from api.cli import audit_fairface, audit_templates

app = typer.Typer(no_args_is_help=True)


@app.callback()
def audit() -> None:
    """Attack private templates, and hold the results against your limits."""


app.command()(audit_fairface.fairface)
app.command()(audit_templates.templates)
