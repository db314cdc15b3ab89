"""``veilface bench``: how fast this machine is, as ratios to what it cannot do without."""

import typer

from api.cli.bench_distances import distances
from api.cli.bench_models import models

app = typer.Typer(no_args_is_help=True)


@app.callback()
def bench() -> None:
    """Time this machine, against the work that nothing can avoid."""


app.command()(distances)
app.command()(models)
