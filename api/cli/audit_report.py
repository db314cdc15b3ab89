"""What ``veilface audit`` writes and shows, and the limits that it takes."""

import functools
import inspect
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from rich.table import Table

from api.cli.console import demo_notice, emit, say, share_done, show, table
from api.cli.errors import FAILED
from api.cli.html_report import write_html
from attacks.outcomes import Scheme
from attacks.report import RESULTS, Document
from attacks.report_tables import markdown
from attacks.verdict import LIMITS
from models.pack import ModelPack
from templates.keys.private_file import replace_public
from verify.preparation import recorded_of

Out = Annotated[Path, typer.Option(help="Folder of the report.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed for everything random.")]

NOT_SHOWN = 3
"""Exit status where nothing fails, and not everything is shown to hold."""
CAPTIONS = {
    "figure": "Attributes inferred from templates, by dimension",
    "linkage": "Local linkability D(s) of the templates of two tenants",
    "oracle": "What the paper's oracle gets",
}

R = TypeVar("R")


def takes_limits(*names: str) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a command a flag ``--max-NAME`` for each named limit.

    The command's parameter ``limits`` receives their values by name.
    """
    chosen = {
        f"max_{limit.name.replace('-', '_')}": limit for limit in LIMITS if limit.name in names
    }

    def decorate(command: Callable[..., R]) -> Callable[..., R]:
        @functools.wraps(command)
        def run(**given: Any) -> R:
            limits = {limit.name: given.pop(flag) for flag, limit in chosen.items()}
            return command(limits=limits, **given)

        flags = [
            inspect.Parameter(
                flag,
                inspect.Parameter.KEYWORD_ONLY,
                default=limit.default,
                annotation=Annotated[
                    float,
                    typer.Option(
                        min=0.0,
                        max=1.0,
                        help=f"Most that passes: {limit.meaning}.",
                        rich_help_panel="Limits",
                    ),
                ],
            )
            for flag, limit in chosen.items()
        ]
        own = [p for p in inspect.signature(command).parameters.values() if p.name != "limits"]
        run.__signature__ = inspect.Signature([*own, *flags])  # type: ignore[attr-defined]
        return run

    return decorate


@contextmanager
def share_once_begun(description: str) -> Iterator[Callable[[float], None]]:
    """Show per cent as :func:`share_done` does, from the first share that is reported.

    An audit may refuse what it was given before it begins: no bar stands above that sentence.
    """
    with ExitStack() as stack:
        shown: list[Callable[[float], None]] = []

        def report(share: float) -> None:
            if not shown:
                shown.append(stack.enter_context(share_done(description)))
            shown[0](share)

        yield report


def write_report(report: Document, out: Path) -> list[Path]:
    """Write the document, its Markdown, its figures and its HTML; return their files."""
    # Imported here: drawing loads a library that nothing else needs.
    from attacks.figures import write_figures

    out.mkdir(parents=True, exist_ok=True)
    files = [out / "report.json", out / "report.md"]
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    replace_public(files[0], text.encode())
    written = markdown(report)
    replace_public(files[1], written.encode())
    figures = write_figures(report, out)
    return [*files, *figures, write_html(out / "report.html", written, figures, CAPTIONS)]


def model_json(pack: ModelPack) -> dict[str, Any]:
    """State which model gave the embeddings."""
    return {**recorded_of(pack), "embedder_sha256": pack.info.embedder_sha256}


def conclude(report: Document, out: Path, pack: ModelPack, *, as_json: bool) -> None:
    """Write the report, say first how it ended; leave with status 1 or 3 where it did not pass."""
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    files = write_report(report, out)
    if as_json:
        emit({**notice, "out": str(out), "files": [path.name for path in files], **report})
    else:
        say(RESULTS[report["passed"]])
        for sentence in report["headlines"]:
            say(sentence)
        for sentence in report["comparison_headlines"]:
            say(f"For comparison: {sentence}")
        show(*verdict_tables(report))
        say(f"{out}: {', '.join(path.name for path in files)}.")
        say(f"To read it: {out / 'report.html'}")
    if not report["passed"]:
        raise typer.Exit(NOT_SHOWN if report["passed"] is None else FAILED)


def verdict_tables(report: Document) -> list[Table]:
    """Show how the strongest attacks stand against the limits; one table for each scheme."""
    made = []
    for verdict in report["verdicts"]:
        if not verdict["cells"]:  # a line above says so
            continue
        title = f"Verdict on {Scheme.of(verdict)}" + (
            ", for comparison" if verdict["comparison"] else ""
        )
        listing = table(
            title, "property", "leaked", "attacker has", "strongest attack", "reached (95 %)",
            "by chance", "compared", "limit", "",
        )  # fmt: skip
        for cell in verdict["cells"]:
            variant = f" ({cell['variant']})" if cell["variant"] else ""
            listing.add_row(
                cell["property"],
                cell["leaked"],
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
