"""The DET curve of presentation attack detection: APCER of each species against BPCER."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from verify.evaluation.figures.curves import EQUAL, PANEL_INCHES, SIDE_INCHES, draw_det, dress_det
from verify.evaluation.figures.style import HUES, MARKERS, house_style, panels, side_legend
from verify.evaluation.row_labels import Row
from verify.metrics import wilson


def liveness_figure(results: Row) -> Figure:
    """Draw BPCER over APCER on normal-deviate axes, with the 95 % band of the BPCER.

    A cross marks each threshold of the results on the curve of its species. An APCER of 0 is drawn
    as that of half a photo, where the axis begins.
    """
    live = int(results["rows"][0]["bpcer"]["trials"])
    attacks = {row["species"]: int(row["apcer"]["trials"]) for row in results["rows"]}
    with house_style():
        width, height = PANEL_INCHES
        figure, grid = panels(1, 1, widths=[width], heights=[height], side=SIDE_INCHES)
        axes = grid[0][0]
        handles = []
        for number, curve in enumerate(results["curves"]):
            look: dict[str, Any] = {
                "color": HUES[number % len(HUES)],
                "marker": MARKERS[number % len(MARKERS)],
                "linewidth": 1.7,
                "markersize": 6,
                "markeredgecolor": "white",
                "markeredgewidth": 0.7,
            }
            apcer, bpcer = (np.asarray(curve[key]) for key in ("apcer", "bpcer"))
            apcer = np.maximum(apcer, 0.5 / attacks[curve["species"]])
            bands = np.array([wilson(rate * live, live) for rate in bpcer])
            draw_det(axes, apcer, bpcer, bands[:, 0], bands[:, 1], look)
            handles.append(Line2D([], [], **look, label=curve["species"]))
        dress_det(axes, "APCER", "BPCER")
        for row in results["rows"]:
            axes.plot(
                [max(row["apcer"]["value"], 0.5 / attacks[row["species"]])],
                [row["bpcer"]["value"]],
                marker="x",
                color=EQUAL["color"],
                linestyle="none",
            )
        axes.set_title(f"{results['dataset']['name']}, presentation attacks", loc="left")
        handles.append(Line2D([], [], **EQUAL, label="APCER = BPCER"))
        handles.append(
            Line2D([], [], marker="x", color=EQUAL["color"], linestyle="none", label="threshold")
        )
        side_legend(figure, handles, SIDE_INCHES)
    return figure
