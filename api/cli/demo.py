"""``veilface demo``: everything once, with nothing configured."""

import dataclasses
import os
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import message
from api.cli.results import Result, Table, reports
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
        Path | None,
        typer.Option(
            help="A real model pack, with --faces. Unset: a model that is built here and "
            "recognises only cartoon faces."
        ),
    ] = None,
    faces: Annotated[
        Path | None,
        typer.Option(
            help="Real faces, one subfolder for each person; 8 people need 5 photos each, and the "
            "others serve as decoys and for the calibration."
        ),
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
    return Result(_facts(outcome), _text(outcome), error=next(iter(outcome.faults[-1:]), None))


def _text(outcome: Outcome) -> list[str | Table]:
    notice = f"  ({DEMO_NOTICE})" if outcome.demo_model else ""
    text: list[str | Table] = [f"\n{DEMO_NOTICE}\n"] if outcome.demo_model else []
    text += [
        Table(
            f"Who was accepted, at level {outcome.default_level}{notice}",
            ("person", "own photos", "photos of others"),
            [
                (
                    one.name,
                    f"{one.genuine_accepted} of {one.genuine_trials} accepted",
                    f"{one.impostor_trials - one.impostors_accepted} of {one.impostor_trials} "
                    "rejected",
                )
                for one in outcome.people
            ],
        ),
        Table(
            f"Security levels{notice}",
            ("level", "stated FMR", "genuine accepted", "impostors accepted"),
            [
                (
                    one.name,
                    f"{100 * one.fmr:g} %",
                    f"{one.genuine_accepted} of {one.genuine_trials}",
                    f"{one.impostors_accepted} of {one.impostor_trials}",
                )
                for one in outcome.levels
            ],
        ),
        Table(
            f"What is stored: {outcome.strategy}{notice}",
            (
                "person",
                "template",
                "‖p‖ = cos(face, foot point)",
                "in the database",
                "16 bytes of it (ciphertext)",
            ),
            [
                (
                    one.name,
                    f"{one.template_bytes} bytes",
                    f"{one.foot_norm:.3f}",
                    f"{one.ciphertext_bytes} bytes, AES-256-GCM",
                    one.ciphertext_excerpt,
                )
                for one in outcome.stored
            ],
        ),
    ]
    text += [f"Not usable, counted as rejected: {refusal}" for refusal in outcome.refused_photos]
    if outcome.receipt:
        text.append(
            f"Erased {outcome.erased}: {outcome.rows_after_erasure} rows left, and a valid signed "
            f"receipt for the pseudonym {outcome.receipt['subject'][:16]}…"
        )
    text += verdict_lines(outcome.verdict)
    folder = outcome.folder
    text.append(
        f"\nDone in {outcome.seconds:.0f} s. Start the service on the same data:\n\n"
        f"  {_program()} serve --config {folder}/veilface.toml\n\n"
        "and open http://127.0.0.1:8421/ with the API key, which is in a file that only you can "
        f"read:\n\n  cat {folder}/api-key\n\n"
        "or ask it, in another terminal:\n\n"
        f'  curl -H "Authorization: Bearer $(cat {folder}/api-key)" '
        "http://127.0.0.1:8421/v1/subjects\n"
    )
    return [*text, DEMO_NOTICE] if outcome.demo_model else text


def _program() -> str:
    """Return what to type for this program: its name, or its path where it is not found by name."""
    program = Path(sys.argv[0])
    if program.name != "veilface" or shutil.which("veilface") == str(program.absolute()):
        return "veilface"
    return os.path.relpath(program)


def _facts(outcome: Outcome) -> dict[str, Any]:
    notice = {"notice": DEMO_NOTICE} if outcome.demo_model else {}
    return {
        **{part.name: getattr(outcome, part.name) for part in dataclasses.fields(outcome)},
        **notice,
    }
