"""DET curves: one error rate over the other on normal-deviate axes, with bands of uncertainty."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtr, ndtri

from verify.evaluation.figures.style import (
    DASHES,
    HUES,
    INK,
    MARKERS,
    QUIET,
    RULE,
    SMALL_SIZE,
    house_style,
    panels,
)
from verify.evaluation.row_labels import (
    LIFTED_MODES,
    METRIC_NAMES,
    MODE_NAMES,
    Row,
    datasets_of,
    strategy_label,
)

Look = dict[str, Any]
RATE_TICKS = (1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999)
SMALLEST = 1e-7
BAND_ALPHA = 0.11
PANEL_INCHES = (4.6, 4.3)
SIDE_INCHES = 3.1


def det_figure(results: Mapping[str, Any]) -> Figure | None:
    """Draw FNMR over FMR; None where no lifted or raw curve is there.

    One panel for each data set and mode. The metric is spherical where it was run, and of the
    dimensions the smallest (dashed) and the largest that all strategies of the panel have; raw
    embeddings are in every panel as a reference. Bands are 95 %.
    """
    curves = [curve for curve in results["curves"] if len(curve["fmr"]) > 1]
    names = [name for name in datasets_of(results) if any(c["dataset"] == name for c in curves)]
    if not names:
        return None
    present = {curve["mode"] for curve in curves}
    # Without lifting the reference alone makes one panel.
    modes = [mode for mode in LIFTED_MODES if mode in present] or ["p2p"]
    looks: dict[str, Look] = {"raw": {"color": INK, "linewidth": 2.2, "zorder": 4}}
    with house_style():
        width, height = PANEL_INCHES
        widths, heights = [width] * len(modes), [height] * len(names)
        figure, grid = panels(
            len(names), len(modes), widths=widths, heights=heights, side=SIDE_INCHES
        )
        for axes, (name, mode) in zip(
            (axes for line in grid for axes in line),
            [(name, mode) for name in names for mode in modes],
            strict=True,
        ):
            shown = shown_curves([c for c in curves if c["dataset"] == name], mode)
            largest = max(curve["dim"] for curve in shown)
            drawn = []
            for curve in shown:
                label = strategy_label(curve)
                look = looks.setdefault(label, _look(len(looks) - 1))
                dash = DASHES[1] if 0 < curve["dim"] < largest else DASHES[0]
                dim = f", m = {curve['dim']}" if curve["dim"] else ""
                drawn.append((curve, look | {"linestyle": dash, "label": label + dim}))
            _draw(axes, drawn)
            metric = next((METRIC_NAMES[c["metric"]] for c in shown if c["dim"]), None)
            axes.set_title(", ".join(filter(None, [name, MODE_NAMES[mode], metric])), loc="left")
        _legend(figure)
    return figure


def shown_curves(curves: Sequence[Row], mode: str) -> list[Row]:
    """Return the curves of one panel, out of those of one data set, in the order of the tables."""
    lifted = [curve for curve in curves if curve["mode"] == mode and mode in LIFTED_MODES]
    metrics = {curve["metric"] for curve in lifted}
    metric = "spherical" if "spherical" in metrics else "euclidean"
    lifted = [curve for curve in lifted if curve["metric"] == metric]
    by_group: dict[str, set[int]] = {}
    for curve in lifted:
        by_group.setdefault(strategy_label(curve), set()).add(int(curve["dim"]))
    shared = set.intersection(*by_group.values()) if by_group else set()
    ends = {label: {min(shared or dims), max(shared or dims)} for label, dims in by_group.items()}
    lifted = [curve for curve in lifted if int(curve["dim"]) in ends[strategy_label(curve)]]
    raw = [curve for curve in curves if curve["strategy"] == "raw"]
    return raw + lifted


def _legend(figure: Figure) -> None:
    """Name every curve once, right of the panels."""
    handles = {
        str(handle.get_label()): handle
        for axes in figure.axes
        for handle in axes.get_legend_handles_labels()[0]
    }
    figure.legend(
        handles=list(handles.values()), loc="center right", fontsize=SMALL_SIZE, handlelength=2.8
    )


def _look(number: int) -> Look:
    """Return how the curve of a strategy is drawn: hue and marker."""
    return {
        "color": HUES[number % len(HUES)],
        "marker": MARKERS[number % len(MARKERS)],
        "linewidth": 1.7,
        "markersize": 6,
        "markeredgecolor": "white",
        "markeredgewidth": 0.7,
    }


def _draw(axes: Axes, curves: Sequence[tuple[Row, Look]]) -> None:
    """Draw the rate ``fnmr`` of each curve over its ``fmr``, with the band from low to high."""
    drawn = []
    for place, (curve, look) in enumerate(curves):
        # A rate of 0 has no deviate: the line leaves the panel through its foot.
        fmr, fnmr, low, high = (
            np.clip(np.asarray(curve[name], dtype=np.float64), SMALLEST, 1 - SMALLEST)
            for name in ("fmr", "fnmr", "low", "high")
        )
        step = max(1, len(fmr) // 6)
        # Six markers, at places of its own: those of close curves do not pile up.
        axes.plot(fmr, fnmr, **look, markevery=(place * step // len(MARKERS) % step, step))
        axes.fill_between(fmr, low, high, color=look["color"], alpha=BAND_ALPHA, linewidth=0)
        drawn.append(np.stack([fmr, fnmr]))
    every = np.concatenate(drawn, axis=1)
    seen = every[1][(every[1] > 10 * SMALLEST) & (every[0] <= 0.5)]
    bottom = 0.8 * float(seen.min(initial=0.0125))
    top = min(0.999, max(0.2, float(seen.max(initial=0.2)) * 1.05))
    for axis, low_end, high_end in (("x", float(every[0].min()), 0.5), ("y", bottom, top)):
        getattr(axes, f"set_{axis}scale")("function", functions=(_deviate, ndtr))
        ticks = [rate for rate in RATE_TICKS if low_end * 0.999 <= rate <= high_end]
        names = [f"{100 * rate:.4f}".rstrip("0").rstrip(".") for rate in ticks]
        getattr(axes, f"set_{axis}ticks")(ticks, names)
        getattr(axes, f"set_{axis}lim")((low_end, high_end))
    ends = [SMALLEST, 0.999]
    axes.plot(ends, ends, color=QUIET, linewidth=0.9, label="FMR = FNMR")
    axes.set_xlabel("FMR %")
    axes.set_ylabel("FNMR %")
    axes.grid(color=RULE, linewidth=0.8)


def _deviate(rate: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(ndtri(np.clip(rate, SMALLEST, 1 - SMALLEST)), dtype=np.float64)
