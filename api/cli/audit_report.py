"""What ``veilface audit`` writes and shows, and the limits that it takes."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import demo_notice
from api.cli.errors import FAILED, UsageError
from api.cli.results import Result, Table
from api.settings import Settings
from attacks.report import RESULTS, Document
from attacks.report_tables import VERDICT, markdown, verdict_tables
from attacks.verdict import ATTRIBUTE_LEAKAGE, LIMITS
from models.pack import ModelPack
from templates.contract.document import Binding, Contract
from templates.decoys import DecoySource
from templates.keys.private_file import replace_public
from templates.keys.sealing import Sealer
from verify.preparation import recorded_of

Out = Annotated[Path, typer.Option(help="Folder of the report.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed for the random choices.")]
Limits = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        metavar="NAME=SHARE",
        help="Most that passes; may be repeated. Unset: "
        + ", ".join(f"`{limit.name}={limit.default:g}`" for limit in LIMITS)
        + f". `audit fairface` takes `{ATTRIBUTE_LEAKAGE}`, `audit templates` the others. "
        "The report says what each limits; 1 limits nothing.",
    ),
]

FAIRFACE_LIMITS = (ATTRIBUTE_LEAKAGE,)
TEMPLATE_LIMITS = tuple(limit.name for limit in LIMITS if limit.name != ATTRIBUTE_LEAKAGE)
"""What each command judges."""

NOT_SHOWN = 3
"""Exit status where nothing fails, and not everything is shown to hold."""


def limits_of(given: Sequence[str] | None, names: Sequence[str]) -> dict[str, float]:
    """Read ``NAME=SHARE`` texts: the limits of the names, the defaults where none is given.

    Raises
    ------
    UsageError
        No such limit, or no share from 0 to 1.
    """
    limits = {limit.name: limit.default for limit in LIMITS if limit.name in names}
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


def write_report(report: Document, out: Path) -> list[Path]:
    """Write the document, its Markdown and its figures; return their files."""
    # Imported here: drawing loads a library that nothing else needs.
    from attacks.figures import write_figures

    out.mkdir(parents=True, exist_ok=True)
    files = [out / "report.json", out / "report.md"]
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    replace_public(files[0], text.encode())
    replace_public(files[1], markdown(report).encode())
    return [*files, *write_figures(report, out)]


def model_json(pack: ModelPack) -> dict[str, Any]:
    """State which model gave the embeddings."""
    return {**recorded_of(pack), "embedder_sha256": pack.info.embedder_sha256}


def reported(report: Document, out: Path, pack: ModelPack) -> Result:
    """Write the report, and say first how it ended; status 1 or 3 where it did not pass."""
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    files = [path.name for path in write_report(report, out)]
    tables = [Table(title, list(VERDICT), cells) for title, cells in verdict_tables(report)]
    return Result(
        {**notice, "out": str(out), "files": files, **report},
        [
            RESULTS[report["passed"]],
            *report["headlines"],
            *(f"For comparison: {sentence}" for sentence in report["comparison_headlines"]),
            *(one for one in tables if one.rows),  # a line above says so of the others
            f"{out}: {', '.join(files)}.",
        ],
        status={True: 0, False: FAILED, None: NOT_SHOWN}[report["passed"]],
    )


def served_scheme(settings: Settings, sealer: Sealer, source: DecoySource | None) -> Binding | None:
    """Return the scheme of the contract in ``data_dir``, where it lifts with this source."""
    path = settings.resolved_contract_file
    if source is None or not path.is_file():
        return None
    binding = Contract.load(path, sealer).binding
    fits = binding.axes <= source.k and (
        binding.decoy_source_id == source.reduced(binding.axes).source_id
    )
    return binding if fits else None
