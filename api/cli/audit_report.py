"""What ``veilface audit`` writes and shows, and the limits that it takes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from api.cli.bulk import Bulk, write_document
from api.cli.console import demo_notice
from api.cli.errors import FAILED, UsageError
from api.cli.results import Result, Table
from attacks.report import RESULTS, Document
from attacks.report_tables import VERDICT, markdown, verdict_tables
from attacks.verdict import LIMITS

Out = Annotated[Path, typer.Option(help="Folder of the report.")]
Limits = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        metavar="NAME=SHARE",
        help="Most that passes; may be repeated. Unset: "
        + ", ".join(f"`{limit.name}={limit.default:g}`" for limit in LIMITS)
        + ". The report says what each limits; 1 limits nothing.",
    ),
]
NOT_SHOWN = 3
"""Exit status where nothing fails, and not everything is shown to hold."""


def limits_of(given: Sequence[str] | None) -> dict[str, float]:
    """Read ``NAME=SHARE`` texts: all limits, the defaults where none is given."""
    limits = {limit.name: limit.default for limit in LIMITS}
    for text in given or ():
        name, _, share = text.partition("=")
        try:
            value = float(share)
        except ValueError:
            value = -1.0
        if name not in limits or not 0 <= value <= 1:
            raise UsageError(
                f"--limit takes NAME=SHARE, a share from 0 to 1 and a name of {', '.join(limits)}, "
                f"not {text!r}"
            )
        limits[name] = value
    return limits


def reported(report: Document, out: Path, bulk: Bulk) -> Result:
    """Write the report, and say first how it ended; status 1 or 3 where it did not pass."""
    # Imported here: drawing loads a library that nothing else needs.
    from attacks.figures import write_figures

    written = write_document(report, out, "report", markdown=markdown(report))
    files = [path.name for path in [*written, *write_figures(report, out)]]
    tables = [Table(title, list(VERDICT), cells) for title, cells in verdict_tables(report)]
    return Result(
        {**demo_notice(bulk.pack.info), "out": out, "files": files, **report},
        [
            RESULTS[report["passed"]],
            *report["headlines"],
            *(f"For comparison: {sentence}" for sentence in report["comparison_headlines"]),
            *(one for one in tables if one.rows),  # a line above says so of the others
            f"{out}: {', '.join(files)}.",
        ],
        status={True: 0, False: FAILED, None: NOT_SHOWN}[report["passed"]],
    )
