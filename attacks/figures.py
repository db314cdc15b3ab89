"""Figures of an audit's report; they read nothing but the document."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from attacks.attributes.figure import attribute_figure
from attacks.outcomes import Property, Scheme
from verify.evaluation.figures.style import (
    DASHES,
    HUES,
    INK_SIZE,
    MARKERS,
    QUIET,
    RULE,
    SMALL_SIZE,
    house_style,
    panels,
    write,
)

Row = Mapping[str, Any]
NAMES = ("figure", "linkage", "oracle")
ORACLE = "oracle"
PANEL_INCHES = (4.8, 3.4)
HEADER_INCHES = 1.3


def write_figures(report: Row, out: Path) -> list[Path]:
    """Write the figures that the report has data for, as PNG and SVG; return their files.

    ``figure`` is the paper's, ``linkage`` the local D(s) of two tenants' templates, ``oracle`` the
    paper's oracle curve.
    """
    drawings: dict[str, Callable[[], Figure | None]] = {
        "figure": lambda: attribute_figure(report["rows"]) if report["rows"] else None,
        "linkage": lambda: linkage_figure(report["outcomes"]),
        "oracle": lambda: oracle_figure(report["outcomes"]),
    }
    # What an earlier run drew of other rows must not stand beside these.
    for name in NAMES:
        for suffix in (".png", ".svg"):
            (out / f"{name}{suffix}").unlink(missing_ok=True)
    files: list[Path] = []
    for name, draw in drawings.items():
        figure = draw()
        if figure is not None:
            files += write(figure, out, name)
    return files


def linkage_figure(outcomes: Sequence[Row]) -> Figure | None:
    """Draw the local D(s) over the score, a line for each setting; None without linkage rows.

    One panel for each scheme (rows) and score (columns). At 1 a score means one person for sure,
    at 0 it tells nothing.
    """
    rows = [row for row in outcomes if row["property"] == Property.UNLINKABILITY]
    if not rows:
        return None
    schemes = list(dict.fromkeys(Scheme.of(row) for row in rows))
    scores = list(dict.fromkeys(row["attack"] for row in rows))
    settings = list(dict.fromkeys(row["variant"] for row in rows))
    with house_style():
        figure, grid = panels(
            len(schemes),
            len(scores),
            widths=[PANEL_INCHES[0]] * len(scores),
            heights=[PANEL_INCHES[1]] * len(schemes),
            header=HEADER_INCHES / 2,
        )
        for row in rows:
            setting, score = row["variant"], row["attack"]
            axes = grid[schemes.index(Scheme.of(row))][scores.index(score)]
            number = settings.index(setting)
            edges, local = row["details"]["score_edges"], row["details"]["local_d"]
            axes.stairs(
                local,
                edges,
                color=HUES[number % len(HUES)],
                linestyle=DASHES[number % len(DASHES)],
                linewidth=1.8,
                label=setting,
            )
            axes.set_ylim(-0.02, 1.05)
            axes.set_title(str(Scheme.of(row)), loc="left", fontsize=INK_SIZE)
            axes.set_xlabel(f"score: {score}")
            axes.set_ylabel("local D(s)")
            axes.grid(color=RULE, linewidth=0.8)
        # A setting may have some of the scores only.
        labelled = {
            label: handle
            for axes in figure.axes
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        _header_legend(figure, (list(labelled.values()), list(labelled)), len(labelled))
    return figure


def oracle_figure(outcomes: Sequence[Row]) -> Figure | None:
    """Draw the mean distance to the truth over K, a line for each scheme and variant."""
    rows = [row for row in outcomes if row["attack"] == ORACLE]
    if not rows:
        return None
    with house_style():
        figure, grid = panels(
            1, 1, widths=[1.5 * PANEL_INCHES[0]], heights=[PANEL_INCHES[1]], header=HEADER_INCHES
        )
        axes = grid[0][0]
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
        _header_legend(figure, axes.get_legend_handles_labels(), 1)
    return figure


def _header_legend(figure: Figure, shown: Any, columns: int) -> None:
    handles, labels = shown
    figure.legend(
        handles,
        labels,
        loc="upper left",
        ncols=columns,
        fontsize=SMALL_SIZE,
        handlelength=3.0,
        borderaxespad=0.4,
    )
