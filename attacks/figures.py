"""Figures of an audit's report; they read nothing but the document."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from attacks.attributes.figure import attribute_figure
from attacks.outcomes import Scheme
from verify.evaluation.figures.style import (
    DASHES,
    HUES,
    MARKERS,
    QUIET,
    RULE,
    SMALL_SIZE,
    house_style,
    panels,
    write,
)

Row = Mapping[str, Any]
ORACLE = "oracle"


def write_figures(report: Row, out: Path) -> list[Path]:
    """Write the figures that the report has data for, as PNG and SVG; return their files.

    ``figure`` is the paper's, ``oracle`` the paper's oracle curve.
    """
    # What an earlier run drew of other rows must not stand beside these.
    for name in ("figure", ORACLE):
        for suffix in (".png", ".svg"):
            (out / f"{name}{suffix}").unlink(missing_ok=True)
    drawings = {
        "figure": attribute_figure(report["rows"]),
        ORACLE: oracle_figure(report["outcomes"]),
    }
    return [
        file
        for name, figure in drawings.items()
        if figure is not None
        for file in write(figure, out, name)
    ]


def oracle_figure(outcomes: Sequence[Row]) -> Figure | None:
    """Draw the mean distance to the truth over K, a line for each scheme and variant."""
    rows = [row for row in outcomes if row["attack"] == ORACLE]
    if not rows:
        return None
    with house_style():
        figure, ((axes,),) = panels(1, 1, widths=[7.2], heights=[3.4], header=1.3)
        for number, row in enumerate(rows):
            curve = row["details"]["curve"]
            axes.plot(
                [point["neighbours"] for point in curve],
                [point["distance_to_truth_mean"] for point in curve],
                color=HUES[number % len(HUES)],
                linestyle=DASHES[number % len(DASHES)],
                marker=MARKERS[number % len(MARKERS)],
                markersize=5,
                linewidth=1.6,
                label=f"{Scheme.of(row)}: {row['variant']}",
            )
        axes.set_xscale("log")
        axes.set_xlabel("neighbours K that the oracle chooses from")
        axes.set_ylabel("mean distance to the embedding")
        axes.set_ylim(0, None)
        axes.axhline(2**0.5, color=QUIET, linewidth=1.2, linestyle=(0, (1.2, 1.4)))
        axes.annotate(
            "unrelated faces",
            (1, 2**0.5),
            xytext=(2, 3),
            textcoords="offset points",
            color=QUIET,
            fontsize=SMALL_SIZE,
        )
        axes.grid(color=RULE, linewidth=0.8)
        figure.legend(loc="upper left", fontsize=SMALL_SIZE, handlelength=3.0, borderaxespad=0.4)
    return figure
