"""What ``veilface evaluate`` and ``veilface evaluate liveness`` write."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from templates.keys.private_file import replace_public
from verify.evaluation.plan import Json
from verify.evaluation.tables import write_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_results(
    results: Json, report: str, drawings: Mapping[str, Callable[[Json], "Figure | None"]], out: Path
) -> list[Path]:
    """Write the document, its rows as CSV, its report in Markdown and the figures.

    ``drawings`` draw a figure by its name; None where the results have nothing for it.
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
    return [*files, *figures]
