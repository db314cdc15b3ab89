"""What ``veilface audit`` writes and shows, and the limits that it takes."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from api.cli.console import emit, say, show, table
from attacks.outcomes import Scheme
from attacks.report import Document
from attacks.report_tables import markdown
from attacks.verdict import LIMITS
from templates.keys.private_file import make_folder, replace_public

FAILED = 1
Out = Annotated[Path, typer.Option(help="Folder of the report.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed for everything random.")]

_DEFAULTS = {limit.name: limit.default for limit in LIMITS}


def limit_option(name: str) -> Any:
    """Return the option that sets a limit."""
    meaning = next(limit.meaning for limit in LIMITS if limit.name == name)
    return typer.Option(
        f"--max-{name}", min=0.0, max=1.0, help=f"Most that passes: {meaning}.",
        rich_help_panel="Limits",
    )  # fmt: skip


def default_of(name: str) -> float:
    """Return the default of a limit."""
    return _DEFAULTS[name]


def write_report(
    report: Document, out: Path, *, evaluation: Mapping[str, Any] | None = None
) -> list[Path]:
    """Write the document, its Markdown and its figures; return their files.

    Parameters
    ----------
    evaluation
        ``results.json`` of an evaluation: adds the figure of privacy against accuracy.
    """
    # Imported here: drawing loads a library that nothing else needs.
    from attacks.figures import write_figures

    make_folder(out)
    files = [out / "report.json", out / "report.md"]
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    replace_public(files[0], text.encode())
    replace_public(files[1], markdown(report).encode())
    return [*files, *write_figures(report, out, evaluation=evaluation)]


def conclude(
    report: Document,
    out: Path,
    *,
    as_json: bool,
    notice: Mapping[str, str],
    evaluation: Mapping[str, Any] | None = None,
) -> None:
    """Write the report, say how it ended, and leave with status 1 where a limit is exceeded."""
    files = write_report(report, out, evaluation=evaluation)
    if as_json:
        emit({**notice, "out": str(out), "files": [path.name for path in files], **report})
    else:
        show(*verdict_tables(report))
        for sentence in report["headlines"]:
            say(sentence)
        for sentence in report["comparison_headlines"]:
            say(f"For comparison: {sentence}")
        say(f"{out}: {', '.join(path.name for path in files)}.")
        say("PASSED" if report["passed"] else "FAILED: a limit is exceeded.")
    if not report["passed"]:
        raise typer.Exit(FAILED)


def verdict_tables(report: Document) -> list[Table]:
    """Show how the strongest attacks stand against the limits; one table for each scheme."""
    made = []
    for verdict in report["verdicts"]:
        title = f"Verdict on {Scheme.of(verdict)}" + (
            ", for comparison" if verdict["comparison"] else ""
        )
        listing = table(
            title, "property", "attacker has", "strongest attack", "reached (95 %)", "by chance",
            "compared", "limit", "",
        )  # fmt: skip
        for cell in verdict["cells"]:
            variant = f" ({cell['variant']})" if cell["variant"] else ""
            listing.add_row(
                cell["property"],
                cell["knowledge"],
                f"{cell['attack']}{variant}",
                f"{cell['value']:.3g} ({cell['ci_low']:.2g}-{cell['ci_high']:.2g})",
                f"{cell['chance']:.3g}",
                f"{cell['compared']:.3g}",
                "" if cell["most"] >= 1 else f"{cell['limit']} {cell['most']:.3g}",
                cell["status"],
            )
        made.append(listing)
    return made
