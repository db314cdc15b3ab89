"""What ``veilface evaluate`` and ``veilface evaluate liveness`` write."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from api.cli.html_report import write_html
from templates.keys.private_file import replace_public
from verify.evaluation.plan import Json
from verify.evaluation.tables import write_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAPTIONS = {
    "figure": "Accuracy by lifting and dimension, beside that of raw embeddings",
    "det": "False non-matches over false matches (DET)",
}
LIVENESS_CAPTIONS = {"det": "Attacks taken for live over live photos taken for attacks (DET)"}


def write_results(
    results: Json,
    report: str,
    drawings: Mapping[str, Callable[[Json], "Figure | None"]],
    captions: Mapping[str, str],
    out: Path,
) -> list[Path]:
    """Write the document, its rows as CSV, its report, the figures and the HTML.

    Parameters
    ----------
    report
        In Markdown.
    drawings, captions
        By the name of a figure: what draws it, None where the results have nothing for it, and
        what it shows.

    Returns
    -------
    The files written.
    """
    # Imported here: drawing loads a library that nothing else needs.
    from verify.evaluation.figures.style import write

    text = json.dumps(results, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    files = [out / "results.json", out / "results.csv", out / "results.md"]
    replace_public(files[0], text.encode())
    write_csv(results["rows"], files[1])
    replace_public(files[2], report.encode())
    figures = []
    for name, draw in drawings.items():
        # What an earlier run drew of other rows must not stand beside these.
        for suffix in (".png", ".svg"):
            (out / f"{name}{suffix}").unlink(missing_ok=True)
        figure = draw(results)
        figures += [] if figure is None else write(figure, out, name)
    return [*files, *figures, write_html(out / "results.html", report, figures, captions)]
