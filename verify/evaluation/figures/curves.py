"""The DET: what each false match rate costs, with the band of its uncertainty."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.special import ndtr, ndtri

from verify.evaluation.figures.style import (
    DASHES,
    HUES,
    INK,
    MARKERS,
    QUIET,
    RULE,
    house_style,
    panels,
    side_legend,
)
from verify.evaluation.row_labels import (
    LIFTED_MODES,
    METRIC_NAMES,
    MODE_NAMES,
    Row,
    datasets_of,
    order_of,
    preferred_metric,
    strategy_label,
)

Array = npt.NDArray[np.float64]
RATE_TICKS = (1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999)
SMALLEST = 1e-7
BAND_ALPHA = 0.11
PANEL_INCHES = (4.6, 4.3)
SIDE_INCHES = 2.75
EQUAL: dict[str, Any] = {"color": QUIET, "linewidth": 0.9}


def shown_curves(curves: Sequence[Row], mode: str) -> list[Row]:
    """Return the curves of one panel, out of those of one data set, in the order of the tables."""
    lifted = [curve for curve in curves if curve["mode"] == mode and mode in LIFTED_MODES]
    metric = preferred_metric(lifted)
    lifted = [curve for curve in lifted if curve["metric"] == metric]
    by_group: dict[str, set[int]] = {}
    for curve in lifted:
        by_group.setdefault(strategy_label(curve), set()).add(int(curve["dim"]))
    shared = set.intersection(*by_group.values()) if by_group else set()
    for curve in lifted:
        dims = shared or by_group[strategy_label(curve)]
        by_group[strategy_label(curve)] = {min(dims), max(dims)}
    lifted = [c for c in lifted if int(c["dim"]) in by_group[strategy_label(c)]]
    raw = [curve for curve in curves if curve["strategy"] == "raw"]
    raw = [curve for curve in raw if curve["metric"] == preferred_metric(raw)]
    return sorted(raw + lifted, key=order_of)


def det_figure(results: Mapping[str, Any]) -> Figure | None:
    """Draw FNMR over FMR on normal-deviate axes; None where no lifted or raw curve is there.

    One panel for each data set and mode. The metric is spherical where it was run, and of the
    dimensions the smallest and the largest that all strategies of the panel have; raw descriptors
    are in every panel as a reference. Bands are 95 %.
    """
    curves = [curve for curve in results.get("curves", ()) if len(curve["fmr"]) > 1]
    names = [name for name in datasets_of(results) if any(c["dataset"] == name for c in curves)]
    present = {curve["mode"] for curve in curves}
    modes = [mode for mode in LIFTED_MODES if mode in present]
    # Without lifting the reference alone makes one panel.
    modes = modes or ["p2p"]
    if not names:
        return None
    with house_style():
        width, height = PANEL_INCHES
        figure, grid = panels(
            len(names),
            len(modes),
            widths=[width] * len(modes),
            heights=[height] * len(names),
            side=SIDE_INCHES,
        )
        looks: dict[str, dict[str, Any]] = {}
        drawn: list[Row] = []
        for line, name in zip(grid, names, strict=True):
            for axes, mode in zip(line, modes, strict=True):
                shown = shown_curves([c for c in curves if c["dataset"] == name], mode)
                drawn += shown
                for curve in shown:
                    fmr, fnmr, low, high = (
                        np.asarray(curve[key], dtype=np.float64)
                        for key in ("fmr", "fnmr", "low", "high")
                    )
                    draw_det(axes, fmr, fnmr, low, high, _look(curve, shown, looks))
                axes.set_title(f"{name}, {_title(mode, shown)}", loc="left")
                dress_det(axes)
        _legend(figure, drawn, looks)
    return figure


def _title(mode: str, shown: Sequence[Row]) -> str:
    metrics = [curve["metric"] for curve in shown if curve["mode"] == mode]
    title = MODE_NAMES[mode]
    return f"{title}, {METRIC_NAMES[metrics[0]]}" if mode in LIFTED_MODES else title


def _look(curve: Row, shown: Sequence[Row], looks: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return how a curve is drawn: strategies by hue and marker, dimensions by dash."""
    label = strategy_label(curve)
    if curve["strategy"] == "raw":
        looks.setdefault(label, {"color": INK, "linewidth": 2.2, "zorder": 4})
    else:
        lifted = [look for look in looks.values() if "marker" in look]
        number = len(lifted) % len(HUES)
        looks.setdefault(
            label,
            {"color": HUES[number], "marker": MARKERS[number], "linewidth": 1.7}
            | {"markersize": 6, "markeredgecolor": "white", "markeredgewidth": 0.7},
        )
        dims = sorted({int(c["dim"]) for c in shown if c["mode"] == curve["mode"]})
        largest = curve["dim"] == dims[-1]
        return looks[label] | {"linestyle": DASHES[0] if largest else DASHES[1]}
    return looks[label]


def _markers(look: dict[str, Any], points: int) -> dict[str, Any]:
    """Set six markers on a curve, at places of its own: those of close curves do not pile up."""
    if "marker" not in look:
        return look
    step = max(1, points // 6)
    number = MARKERS.index(look["marker"])
    return look | {"markevery": (number * step // len(MARKERS), step)}


def draw_det(
    axes: Axes, fmr: Array, fnmr: Array, low: Array, high: Array, look: dict[str, Any]
) -> None:
    """Draw one error rate over the other, with the band of the latter."""
    # A rate of 0 has no deviate: the line leaves the panel through its foot.
    clipped = [np.clip(rate, SMALLEST, 1 - SMALLEST) for rate in (fmr, fnmr, low, high)]
    axes.plot(clipped[0], clipped[1], **_markers(look, len(fmr)))
    axes.fill_between(
        clipped[0], clipped[2], clipped[3], color=look["color"], alpha=BAND_ALPHA, linewidth=0
    )


def _percent(value: float) -> str:
    return f"{100 * value:.4f}".rstrip("0").rstrip(".")


def dress_det(axes: Axes, x: str = "FMR", y: str = "FNMR") -> None:
    """Set scales, ticks and labels of a DET panel whose curves are drawn."""
    lines = axes.get_lines()
    fmr = np.concatenate([np.asarray(line.get_xdata(), dtype=np.float64) for line in lines])
    fnmr = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in lines])
    seen = fnmr[(fnmr > 10 * SMALLEST) & (fmr <= 0.5)]
    left, right = float(fmr.min()), 0.5
    bottom = 0.8 * float(seen.min(initial=0.0125))
    top = min(0.999, max(0.2, float(seen.max(initial=0.2)) * 1.05))

    def deviate(rate: Array) -> Array:
        return np.asarray(ndtri(np.clip(rate, SMALLEST, 1 - SMALLEST)), dtype=np.float64)

    for axis, limits in (("x", (left, right)), ("y", (bottom, top))):
        getattr(axes, f"set_{axis}scale")("function", functions=(deviate, ndtr))
        inside = [rate for rate in RATE_TICKS if limits[0] * 0.999 <= rate <= limits[1]]
        getattr(axes, f"set_{axis}ticks")(inside, [_percent(rate) for rate in inside])
        getattr(axes, f"set_{axis}lim")(limits)
    axes.plot([SMALLEST, 0.999], [SMALLEST, 0.999], **(EQUAL | {"label": f"{x} = {y}"}))
    axes.set_xlabel(f"{x} %")
    axes.set_ylabel(f"{y} %")
    axes.grid(color=RULE, linewidth=0.8)


def _legend(figure: Figure, drawn: Sequence[Row], looks: Mapping[str, dict[str, Any]]) -> None:
    """List strategies right of the panels, then what the dashes say of m."""
    labels = dict.fromkeys(strategy_label(curve) for curve in sorted(drawn, key=order_of))
    handles = [Line2D([], [], **looks[label], label=label) for label in labels]
    by_mode: dict[str, set[int]] = {}
    for curve in drawn:
        if curve["mode"] in LIFTED_MODES:
            by_mode.setdefault(curve["mode"], set()).add(int(curve["dim"]))
    for dash, pick, word in ((DASHES[0], max, "solid"), (DASHES[1], min, "dashed")):
        dims = {
            mode: pick(dims_of_mode)
            for mode, dims_of_mode in by_mode.items()
            if len(dims_of_mode) > 1 or pick is max
        }
        if dims:
            same = len(set(dims.values())) == 1
            text = ", ".join(f"{dim} {MODE_NAMES[mode]}" for mode, dim in dims.items())
            text = str(next(iter(dims.values()))) if same else text
            handles.append(
                Line2D(
                    [], [], color=QUIET, linestyle=dash, linewidth=1.7, label=f"{word}: m = {text}"
                )
            )
    handles.append(Line2D([], [], **EQUAL, label="FMR = FNMR"))
    side_legend(figure, handles, SIDE_INCHES)
