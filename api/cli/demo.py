"""``veilface demo``: everything once, with nothing configured."""

import dataclasses
import os
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import emit, message, say, show, table
from api.cli.options import AsJson
from api.cli.verdict import verdict_lines
from api.demo.run import Outcome, run_demo
from models.demo import DEMO_NOTICE


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
    as_json: AsJson = False,
) -> None:
    """Enroll, verify and erase people through the real service, in under a minute.

    Needs nothing: no weights, no database, no network. It draws faces, makes decoys and a
    contract, starts the REST service on a free local port, uses it over HTTP, checks what it
    answers, and leaves a folder that `veilface serve` can use. Exit status 1 means that something
    was not as promised.

    Example: `veilface demo`, or with real weights and faces
    `veilface demo --pack buffalo_l --faces lfw`
    """
    outcome = run_demo(
        folder, pack=pack, faces=faces, m=dim, say=lambda text: message(f"... {text}")
    )
    if as_json:
        emit(_json(outcome))
    else:
        _print(outcome)
    for fault in outcome.faults:
        message(f"error: {fault}")
    if outcome.faults:
        raise typer.Exit(1)


def _print(outcome: Outcome) -> None:
    notice = f"  ({DEMO_NOTICE})" if outcome.demo_model else ""
    if outcome.demo_model:
        say(f"\n{DEMO_NOTICE}\n")
    people = table(
        f"Who was accepted, at level {outcome.default_level}{notice}",
        "person",
        "own photos",
        "photos of others",
    )
    for person in outcome.people:
        people.add_row(
            person.name,
            f"{person.genuine_accepted} of {person.genuine_trials} accepted",
            f"{person.impostor_trials - person.impostors_accepted} of {person.impostor_trials} "
            "rejected",
        )
    levels = table(
        f"Security levels{notice}",
        "level",
        "stated FMR",
        "genuine accepted",
        "impostors accepted",
    )
    for level in outcome.levels:
        levels.add_row(
            level.level,
            f"{100 * level.fmr:g} %",
            f"{level.genuine_accepted} of {level.genuine_trials}",
            f"{level.impostors_accepted} of {level.impostor_trials}",
        )
    stored = table(
        f"What is stored: {outcome.strategy}{notice}",
        "person",
        "template",
        "‖p‖ = cos(face, foot point)",
        "in the database",
        "16 bytes of it (ciphertext)",
    )
    for entry in outcome.stored:
        stored.add_row(
            entry.name,
            f"{entry.template_bytes} bytes",
            f"{entry.foot_norm:.3f}",
            f"{entry.ciphertext_bytes} bytes, AES-256-GCM",
            entry.ciphertext_excerpt,
        )
    show(people, levels, stored)
    if outcome.locks_lifted:
        say(
            f"Five rejections in a row locked subjects {outcome.locks_lifted} times; each time the "
            "demo lifted the lock, as an operator can."
        )
    for refusal in outcome.refused_photos:
        say(f"Not usable, counted as rejected: {refusal}")
    if outcome.receipt:
        say(
            f"Erased {outcome.erased}: {outcome.rows_after_erasure} rows left, and a valid signed "
            f"receipt for the pseudonym {outcome.receipt['subject'][:16]}…"
        )
    for line in verdict_lines(outcome.verdict):
        say(line)
    folder = outcome.folder
    say(
        f"\nDone in {outcome.seconds:.0f} s. Start the service on the same data:\n\n"
        f"  {_program()} serve --config {folder}/veilface.toml\n\n"
        "and open http://127.0.0.1:8421/ with the API key, which is in a file that only you can "
        f"read:\n\n  cat {folder}/api-key\n\n"
        "or ask it, in another terminal:\n\n"
        f'  curl -H "Authorization: Bearer $(cat {folder}/api-key)" '
        "http://127.0.0.1:8421/v1/subjects\n"
    )
    if outcome.demo_model:
        say(DEMO_NOTICE)


def _program() -> str:
    """Return what to type for this program: its name, or its path where it is not found by name."""
    program = Path(sys.argv[0])
    if program.name != "veilface" or shutil.which("veilface") == str(program.absolute()):
        return "veilface"
    return os.path.relpath(program)


def _json(outcome: Outcome) -> dict[str, Any]:
    value = dataclasses.asdict(outcome)
    value["folder"] = str(outcome.folder)
    value["verdict"] = None if outcome.verdict is None else outcome.verdict.to_json()
    if outcome.demo_model:
        value["notice"] = DEMO_NOTICE
    return value
