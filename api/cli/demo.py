"""``veilface demo``: everything once, with nothing configured."""

import os
import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import message
from api.cli.options import reports
from api.cli.results import Result, Table, shown_facts
from api.cli.verdict import verdict_lines
from api.demo.run import Outcome, run_demo
from models.demo import DEMO_NOTICE


@reports()
def demo(
    *,
    folder: Annotated[
        Path, typer.Option(help="Folder for the data; replaces an earlier demo there.")
    ] = Path("demo-data"),
    pack: Annotated[
        Path | None, typer.Option(help="A real model pack. Unset: one that knows cartoons only.")
    ] = None,
    faces: Annotated[
        Path | None,
        typer.Option(help="Real faces, a subfolder a person; of 8 people 5 photos or more."),
    ] = None,
    dim: Annotated[int, typer.Option(min=1, max=128, help="Dimension m of the templates.")] = 16,
) -> Result:
    """Enroll, verify and erase people through the real service, in under a minute.

    Needs nothing: no weights, no database, no network. It draws faces, makes decoys and a
    contract, starts the REST service on a free local port, checks what it answers over HTTP, and
    leaves a folder that `veilface serve` can use. Exit status 1: something was not as promised.

    Example: `veilface demo`, or with real weights and faces
    `veilface demo --pack buffalo_l --faces lfw`
    """
    outcome = run_demo(
        folder, pack=pack, faces=faces, m=dim, say=lambda text: message(f"... {text}")
    )
    for fault in outcome.faults[:-1]:
        message(f"error: {fault}")
    notice = {"notice": DEMO_NOTICE} if outcome.demo_model else {}
    error = next(iter(outcome.faults[-1:]), None)
    return Result({**vars(outcome), **notice}, _text(outcome), error=error)


def _text(outcome: Outcome) -> list[str | Table]:
    notice = [DEMO_NOTICE] if outcome.demo_model else []
    tables = {
        f"Who was accepted, at level {outcome.level}": outcome.people,
        f"What is stored: {outcome.strategy}": outcome.stored,
    }
    folder = outcome.folder
    text: list[str | Table] = [f"\n{one}\n" for one in notice]
    for title, records in tables.items():
        text += shown_facts(list(records), "  ".join([title, *(f"({one})" for one in notice)]))
    text += [f"Not usable, counted as rejected: {refusal}" for refusal in outcome.refused_photos]
    if outcome.receipt:
        text.append(
            f"Erased {outcome.erased}: {outcome.rows_after_erasure} rows left, and a valid signed "
            f"receipt for the pseudonym {outcome.receipt['subject'][:16]}…"
        )
    text += verdict_lines(outcome.verdict)
    text.append(
        f"\nDone in {outcome.seconds:.0f} s. Start the service on the same data:\n\n"
        f"  {_program()} serve --config {folder}/veilface.toml\n\n"
        "and open http://127.0.0.1:8421/ with the API key, or ask it, in another terminal:\n\n"
        f'  curl -H "Authorization: Bearer $(cat {folder}/api-key)" '
        "http://127.0.0.1:8421/v1/subjects\n"
    )
    return [*text, *notice]


def _program() -> str:
    """Return what to type for this program: its name, or its path where it is not found by name."""
    program = Path(sys.argv[0])
    if program.name != "veilface" or shutil.which("veilface") == str(program.absolute()):
        return "veilface"
    return os.path.relpath(program)
