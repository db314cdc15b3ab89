"""What ``veilface evaluate`` writes and shows."""

import json
from pathlib import Path

from rich.table import Table

from api.cli.console import table
from api.cli.html_report import write_html
from templates.keys.private_file import replace_public
from verify.evaluation.markdown_cells import accuracy, interval_cell, percent
from verify.evaluation.plan import Json
from verify.evaluation.row_labels import fmr_targets, strategy_label
from verify.evaluation.tables import markdown, write_csv

CAPTIONS = {
    "figure": "Accuracy by lifting and dimension, beside that of raw embeddings",
    "det": "False non-matches over false matches (DET)",
}


def write_results(results: Json, out: Path) -> list[Path]:
    """Write the document, the tables, the figures and the HTML; return their files."""
    # Imported here: drawing loads a library that nothing else needs.
    from verify.evaluation.figures import write_figures

    text = json.dumps(results, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    files = [out / "results.json", out / "results.csv", out / "results.md"]
    # What an earlier run drew of other rows must not stand beside these.
    for name in CAPTIONS:
        for suffix in (".png", ".svg"):
            (out / f"{name}{suffix}").unlink(missing_ok=True)
    replace_public(files[0], text.encode())
    write_csv(results["rows"], files[1])
    report = markdown(results)
    replace_public(files[2], report.encode())
    figures = write_figures(results, out)
    return [*files, *figures, write_html(out / "results.html", report, figures, CAPTIONS)]


def summary(results: Json, dataset: str) -> Table:
    """Show the rows of one set."""
    rows = [row for row in results["rows"] if row["dataset"] == dataset]
    targets = fmr_targets(rows)
    listing = table(
        f"{dataset}: {rows[0]['n_genuine']} genuine and {rows[0]['n_impostor']} impostor pairs",
        *("strategy", "m", "mode", "metric", "accuracy %", "EER %"),
        *(f"FNMR % at FMR {target}" for target in targets),
    )
    for row in rows:
        grid = " (grid)" if row["threshold_search"] == "grid" else ""
        listing.add_row(
            strategy_label(row) + grid,
            str(row["dim"] or ""),
            row["mode"],
            row["metric"],
            accuracy(row),
            percent(row["eer"]),
            *(interval_cell(row["fnmr_at_fmr"][target]) for target in targets),
        )
    return listing
