"""The paper's face-verification figure: accuracy by strategy and dimension, raw as a line."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from verify.evaluation.figures.style import (
    INK,
    INK_SIZE,
    QUIET,
    RULE,
    SMALL_SIZE,
    house_style,
    name_groups,
    panels,
)
from verify.evaluation.row_labels import (
    METRIC_NAMES,
    Row,
    datasets_of,
    raw_row,
    strategy_label,
)

PAIR_INCHES, LABEL_PAIRS = 0.25, 4
PANEL_INCHES, HEADER_INCHES, SIDE_INCHES, NARROWEST_INCHES = 2.75, 0.42, 1.3, 7.0
MODE_TITLES = {"p2s": "point to subspace", "s2s": "subspace to subspace"}
LOOKS: dict[str, dict[str, Any]] = {
    "euclidean": {"facecolor": "#fde9c8", "edgecolor": "#7a4a00", "hatch": "/////"},
    "spherical": {"facecolor": "#2f78b7", "edgecolor": "#123a5c"},
}
RAW_LINE: dict[str, Any] = {"color": INK, "linewidth": 1.4, "linestyle": (0, (6, 2))}


def verification_figure(results: Mapping[str, Any]) -> Figure | None:
    """Draw the accuracy of lifted embeddings; None where there is none.

    A column of panels for each data set, p-to-s above s-to-s; a group of bars for each strategy
    with its decoys, a pair of bars for each m: Euclidean hatched, spherical solid. The height of a
    bar is the mean accuracy in per cent, its whisker one standard deviation over the folds, and
    the line across is that of raw embeddings by the same threshold search (the paper has a white
    bar). Both modes have their own scale, the same for all data sets; where it starts is said.
    """
    rows = [
        row
        for row in results["rows"]
        if row["mode"] in MODE_TITLES and row["accuracy_mean"] is not None
    ]
    if not rows:
        return None
    datasets = [name for name in datasets_of(results) if any(r["dataset"] == name for r in rows)]
    modes = [mode for mode in MODE_TITLES if any(row["mode"] == mode for row in rows)]
    metrics = [metric for metric in LOOKS if any(row["metric"] == metric for row in rows)]
    places = {mode: _places([row for row in rows if row["mode"] == mode]) for mode in modes}
    pairs = max(max(by_bar.values()) for by_bar in places.values()) + 2
    width = max(pairs * PAIR_INCHES + SIDE_INCHES, NARROWEST_INCHES / len(datasets))
    with house_style():
        figure, grid = panels(
            len(modes),
            len(datasets),
            widths=[width] * len(datasets),
            heights=[PANEL_INCHES] * len(modes),
            header=HEADER_INCHES,
        )
        raws = {name: raw_row(results["rows"], name) for name in datasets}
        for line, mode in zip(grid, modes, strict=True):
            shown = [row for row in rows if row["mode"] == mode]
            floor = _floor([*shown, *(raw for raw in raws.values() if raw)])
            for axes, name in zip(line, datasets, strict=True):
                own = [row for row in shown if row["dataset"] == name]
                _bars(axes, own, places[mode], metrics)
                _raw_line(axes, raws[name])
                _dress(axes, places[mode], floor, f"{name}, {MODE_TITLES[mode]}")
            line[0].set_ylabel("accuracy %")
        _legend(figure, metrics)
    return figure


def _places(rows: Sequence[Row]) -> dict[tuple[str, int], float]:
    """Where the pairs of bars stand, by strategy with its decoys and by m, in widths of a pair."""
    dims: dict[str, set[int]] = {}
    for row in rows:
        dims.setdefault(strategy_label(row), set()).add(int(row["dim"]))
    places: dict[tuple[str, int], float] = {}
    edge = 1.0
    for label, own in dims.items():
        # The name of a group is wider than a few bars.
        width = max(len(own), LABEL_PAIRS)
        for number, dim in enumerate(sorted(own)):
            places[label, dim] = edge + (width - len(own)) / 2 + number
        edge += width + 1
    return places


def _bars(
    axes: Axes, rows: Sequence[Row], places: Mapping[tuple[str, int], float], metrics: Sequence[str]
) -> None:
    width = 0.42 if len(metrics) == 2 else 0.7
    for number, metric in enumerate(metrics):
        chosen = [row for row in rows if row["metric"] == metric]
        shift = (number - (len(metrics) - 1) / 2) * width
        axes.bar(
            [places[strategy_label(row), int(row["dim"])] + shift for row in chosen],
            [100 * row["accuracy_mean"] for row in chosen],
            width,
            yerr=[100 * row["accuracy_std"] for row in chosen],
            error_kw={"ecolor": INK, "elinewidth": 1.1, "capsize": 1.6, "capthick": 1.1},
            linewidth=0.8,
            **LOOKS[metric],
        )


def _raw_line(axes: Axes, raw: Row | None) -> None:
    if raw is None or raw["accuracy_mean"] is None:
        return
    value = 100 * raw["accuracy_mean"]
    axes.axhline(value, zorder=5, **RAW_LINE)
    axes.annotate(
        f"raw\n{value:.2f}",
        (1, value),
        xycoords=("axes fraction", "data"),
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        fontsize=SMALL_SIZE,
        annotation_clip=False,
    )


def _floor(rows: Sequence[Row]) -> float:
    """Return where the vertical axis starts: a twentieth of its height below the lowest foot."""
    foot = min(100 * (r["accuracy_mean"] - r["accuracy_std"]) for r in rows if r["accuracy_mean"])
    return float(np.clip(np.floor(foot - (100 - foot) / 20), 0, 99))


def _dress(axes: Axes, places: Mapping[tuple[str, int], float], floor: float, title: str) -> None:
    axes.set_ylim(floor, 100 + (100 - floor) * 0.05)
    axes.set_xlim(0, max(places.values()) + 1)
    axes.grid(axis="y", color=RULE, linewidth=0.8)
    axes.set_xticks(list(places.values()), [str(dim) for _, dim in places])
    axes.tick_params(axis="x", length=0, pad=2)
    centres = []
    for label in dict.fromkeys(label for label, _ in places):
        own = [place for (name, _), place in places.items() if name == label]
        centres.append((label.replace(" (", "\n("), (own[0] + own[-1]) / 2))
    name_groups(axes, centres, below=18, fontsize=INK_SIZE, linespacing=1.15)
    axes.set_title(title, loc="left", pad=9)
    if floor > 0:
        start = f"axis starts at {floor:g} %"
        axes.set_title(start, loc="right", fontsize=SMALL_SIZE, fontweight="normal", color=QUIET)


def _legend(figure: Figure, metrics: Sequence[str]) -> None:
    whisker: dict[str, Any] = {
        "marker": "|",
        "markersize": 11,
        "markeredgewidth": 1.1,
        "linestyle": "none",
    }
    handles: list[Patch | Line2D] = [
        *(Patch(label=METRIC_NAMES[name], linewidth=0.8, **LOOKS[name]) for name in metrics),
        Line2D([], [], label="raw", **RAW_LINE),
        Line2D([], [], color=INK, label="± 1 std over folds", **whisker),
    ]
    figure.legend(handles=handles, loc="upper center", ncols=4, columnspacing=1.6)
