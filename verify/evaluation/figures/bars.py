"""The paper's face-verification figure: accuracy by strategy and dimension, raw as a line."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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
    mark_cut,
    name_groups,
    panels,
)
from verify.evaluation.row_labels import (
    METRIC_NAMES,
    Row,
    datasets_of,
    decoys_label,
    order_of,
    raw_row,
)

CHANCE = 50.0
PAIR_INCHES = 0.25
CHARACTER_INCHES = 0.088
GAP_PAIRS = 0.9
WIDEST_INCHES = 15.0
PANEL_INCHES = 2.75
HEADER_INCHES = 0.42
NARROWEST_INCHES = 7.0
SIDE_INCHES = 1.3
FLOORS = (99.0, 98.0, 97.0, 96.0, 95.0, 94.0, 92.0, 90.0, 85.0, 80.0, 75.0, 70.0, 60.0, CHANCE)
MODE_TITLES = {"p2s": "point to subspace", "s2s": "subspace to subspace"}
LOOKS: dict[str, dict[str, Any]] = {
    "euclidean": {"facecolor": "#fde9c8", "edgecolor": "#7a4a00", "hatch": "/////"},
    "spherical": {"facecolor": "#2f78b7", "edgecolor": "#123a5c"},
}
Group = tuple[str, str, bool]


@dataclass(frozen=True)
class _Layout:
    """Where the pairs of bars stand: group to dimension to place, in widths of a pair."""

    places: Mapping[Group, Mapping[int, float]]
    centres: Mapping[Group, float]
    names: Mapping[Group, str]
    width: float


def verification_figure(results: Mapping[str, Any]) -> Figure | None:
    """Draw the accuracy of lifted descriptors; None where there are none.

    One column of panels for each data set, p-to-s above s-to-s; a group of bars for each strategy
    with its decoys, a pair of bars for each m: Euclidean hatched, spherical solid. The height of a
    bar is the mean accuracy in per cent, its whisker one standard deviation over the folds, and
    the line across is that of raw descriptors by the same threshold search (the paper has a white
    bar). Both modes have their own scale, the same for all data sets; where it does not start at 0
    the axis is cut and the start is written out. More data sets than fit side by side continue
    below.
    """
    rows = [row for row in results["rows"] if row["mode"] in MODE_TITLES and _measured(row)]
    if not rows:
        return None
    datasets = [n for n in datasets_of(results) if any(row["dataset"] == n for row in rows)]
    modes = [mode for mode in MODE_TITLES if any(row["mode"] == mode for row in rows)]
    metrics = [metric for metric in LOOKS if any(row["metric"] == metric for row in rows)]
    with house_style():
        layout = _layout(rows)
        column = layout.width * PAIR_INCHES + SIDE_INCHES
        column = max(column, NARROWEST_INCHES if len(datasets) == 1 else 0)
        across = max(1, min(len(datasets), int(WIDEST_INCHES // column)))
        across = math.ceil(len(datasets) / math.ceil(len(datasets) / across))
        blocks = [datasets[i : i + across] for i in range(0, len(datasets), across)]
        figure, grid = panels(
            len(blocks) * len(modes),
            across,
            widths=[column] * across,
            heights=[PANEL_INCHES] * len(modes) * len(blocks),
            header=HEADER_INCHES,
        )
        scales = {mode: _scale(results, [r for r in rows if r["mode"] == mode]) for mode in modes}
        for block, names in enumerate(blocks):
            for line, mode in enumerate(modes):
                for place, axes in enumerate(grid[block * len(modes) + line]):
                    if place >= len(names):
                        axes.set_axis_off()
                        continue
                    cells = [r for r in rows if r["dataset"] == names[place] and r["mode"] == mode]
                    _bars(axes, cells, layout, metrics)
                    _raw_line(axes, raw_row(results["rows"], names[place]))
                    _dress(axes, layout, scales[mode])
                    if line == 0:
                        axes.set_title(names[place], loc="left", pad=9)
                    if place == 0:
                        axes.set_ylabel(f"{_title(mode, cells)}\naccuracy %")
        figure.align_ylabels([line[0] for line in grid])
        raws = [raw_row(results["rows"], name) for name in datasets]
        _legend(figure, metrics, raw=any(raw and _measured(raw) for raw in raws))
    return figure


def _measured(row: Row) -> bool:
    return row.get("accuracy_mean") is not None


def _merged(rows: Sequence[Row]) -> bool:
    """Return whether every s-to-s row with a pool shares it: then sharing splits no group."""
    return all(row.get("shared_decoys") is not False for row in rows if row["mode"] == "s2s")


def _layout(rows: Sequence[Row]) -> _Layout:
    merged = _merged(rows)
    dims: dict[Group, set[int]] = {}
    names: dict[Group, str] = {}
    for row in sorted(rows, key=order_of):
        group = _placed(row, merged)
        dims.setdefault(group, set()).add(int(row["dim"]))
        decoys = group[1] if merged else decoys_label(row)
        names.setdefault(group, f"{row['strategy']}\n{decoys}".rstrip())
    places: dict[Group, dict[int, float]] = {}
    centres: dict[Group, float] = {}
    edge = 0.0
    for group, present in dims.items():
        needed = max(map(len, names[group].split("\n"))) * CHARACTER_INCHES / PAIR_INCHES
        width = max(len(present), needed)
        first = edge + (width - len(present)) / 2 + 0.5
        places[group] = {dim: first + i for i, dim in enumerate(sorted(present))}
        centres[group] = edge + width / 2
        edge += width + GAP_PAIRS
    return _Layout(places, centres, names, edge - GAP_PAIRS)


def _placed(row: Row, merged: bool) -> Group:
    shared = bool(row.get("shared_decoys")) and not merged
    return str(row["strategy"]), str(row.get("decoys") or ""), shared


def _bars(axes: Axes, rows: Sequence[Row], layout: _Layout, metrics: Sequence[str]) -> None:
    width = 0.42 if len(metrics) == 2 else 0.7
    for number, metric in enumerate(metrics):
        chosen = [row for row in rows if row["metric"] == metric]
        if not chosen:
            continue
        merged = not any(shared for _, _, shared in layout.places)
        shift = (number - (len(metrics) - 1) / 2) * width
        axes.bar(
            [layout.places[_placed(row, merged)][int(row["dim"])] + shift for row in chosen],
            [100 * float(row["accuracy_mean"]) for row in chosen],
            width,
            yerr=[100 * float(row.get("accuracy_std") or 0) for row in chosen],
            error_kw={"ecolor": INK, "elinewidth": 1.1, "capsize": 1.6, "capthick": 1.1},
            label=METRIC_NAMES[metric],
            linewidth=0.8,
            **LOOKS[metric],
        )


def _raw_line(axes: Axes, raw: Row | None) -> None:
    if raw is None or raw.get("accuracy_mean") is None:
        return
    value = 100 * float(raw["accuracy_mean"])
    axes.axhline(value, color=INK, linewidth=1.4, linestyle=(0, (6, 2)), zorder=5, label="raw")
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


def _scale(results: Row, rows: Sequence[Row]) -> tuple[float, float]:
    """Return the vertical limits of a mode in per cent."""
    feet = [100 * (float(r["accuracy_mean"]) - float(r.get("accuracy_std") or 0)) for r in rows]
    means = [100 * float(row["accuracy_mean"]) for row in rows]
    raws = [raw_row(results["rows"], name) for name in {str(row["dataset"]) for row in rows}]
    means += [100 * float(raw["accuracy_mean"]) for raw in raws if raw and _measured(raw)]
    # A twentieth of the height stays below the lowest, so that each bar can be seen; a bar at
    # chance has no height above chance.
    floor = next((f for f in FLOORS if min(feet + means) >= f + (100 - f) / 20), CHANCE)
    if min(means) < CHANCE:
        floor = 0.0
    heads = [100 * (float(r["accuracy_mean"]) + float(r.get("accuracy_std") or 0)) for r in rows]
    top = max(100 + (100 - floor) * 0.03, max(heads) + (100 - floor) * 0.02)
    return floor, min(top, 100 + (100 - floor) * 0.3)


def _dress(axes: Axes, layout: _Layout, scale: tuple[float, float]) -> None:
    floor, top = scale
    axes.set_ylim(floor, top)
    axes.set_xlim(-0.6, layout.width + 0.6)
    axes.set_yticks(_ticks(floor))
    axes.grid(axis="y", color=RULE, linewidth=0.8)
    marks = [(place, dim) for dims in layout.places.values() for dim, place in dims.items()]
    axes.set_xticks([place for place, _ in marks], [str(dim) for _, dim in marks])
    axes.tick_params(axis="x", length=0, pad=2)
    names = [(layout.names[group], centre) for group, centre in layout.centres.items()]
    name_groups(axes, names, below=18, fontsize=INK_SIZE, linespacing=1.15)
    if floor > 0:
        mark_cut(axes)
        start = f"axis starts at {floor:g} %" + (" (chance)" if floor == CHANCE else "")
        axes.set_title(start, loc="right", fontsize=SMALL_SIZE, fontweight="normal", color=QUIET)


def _ticks(floor: float) -> list[float]:
    """Return the marks of the vertical axis: up to 100, though a whisker may reach beyond."""
    span = 100 - floor
    step = next(s for s in (0.2, 0.5, 1, 2, 5, 10, 20) if span / s <= 6)
    return [round(100 - i * step, 6) for i in range(int(span / step + 1e-9), -1, -1)]


def _title(mode: str, rows: Sequence[Row]) -> str:
    if mode == "s2s" and _merged(rows) and any(row.get("shared_decoys") for row in rows):
        return f"{MODE_TITLES[mode]},\nshared pool"
    return MODE_TITLES[mode]


def _legend(figure: Figure, metrics: Sequence[str], *, raw: bool) -> None:
    handles: list[Patch | Line2D] = [
        Patch(label=METRIC_NAMES[metric], linewidth=0.8, **LOOKS[metric]) for metric in metrics
    ]
    if raw:
        handles.append(Line2D([], [], color=INK, linewidth=1.4, linestyle=(0, (6, 2)), label="raw"))
    handles.append(
        Line2D(
            [],
            [],
            color=INK,
            linestyle="none",
            marker="|",
            markersize=11,
            markeredgewidth=1.1,
            label="± 1 std over folds",
        )
    )
    figure.legend(
        handles=handles,
        loc="upper center",
        ncols=min(len(handles), 4),
        handlelength=2.2,
        columnspacing=1.6,
    )
