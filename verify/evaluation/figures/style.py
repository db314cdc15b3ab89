"""How every figure looks, and how it is written without a date or a global state.

Figures have an opaque white ground. Text that is legible on both a white and a dark page cannot
exist: the contrasts of one colour against #ffffff and #0d1117 multiply to 18.9, whatever the
colour, and 4.5 on both would need 20.25. So a figure brings its ground, and in print the ground is
the paper.

Hues are those of Okabe and Ito, which the colour-blind tell apart; nothing is told by hue alone:
each has a hatch, a marker or a dash of its own, and they differ in lightness.
"""

import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from templates.keys.private_file import replace_public

GROUND = "#ffffff"
INK = "#1b1f24"
QUIET = "#57606a"
RULE = "#d8dee4"
INK_SIZE, SMALL_SIZE = 11.0, 9.5
PNG_DPI = 160

HUES = ("#0072b2", "#d55e00", "#008f68", "#a2497c", "#8a6d00", "#3a3a3a", "#56a0d3", "#c98500")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES: tuple[Any, ...] = ("solid", (0, (5, 1.6)), (0, (1.2, 1.4)), (0, (5, 1.4, 1.2, 1.4)))

_SETTINGS: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.labelsize": INK_SIZE,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlesize": INK_SIZE + 1,
    "axes.titleweight": "bold",
    "figure.edgecolor": GROUND,
    "figure.facecolor": GROUND,
    "font.family": "sans-serif",
    "font.size": INK_SIZE,
    "hatch.linewidth": 0.8,
    "legend.fontsize": INK_SIZE,
    "legend.frameon": False,
    "savefig.facecolor": GROUND,
    # Text stays text: it is searched, read aloud and small. Salted ids do not change with the run.
    "svg.fonttype": "none",
    "svg.hashsalt": "veilface",
    "text.color": INK,
    # Names are foreign text: a dollar is a dollar.
    "text.parse_math": False,
    "xtick.color": QUIET,
    "xtick.labelcolor": INK,
    "xtick.labelsize": SMALL_SIZE,
    "ytick.color": QUIET,
    "ytick.labelcolor": INK,
    "ytick.labelsize": SMALL_SIZE,
}


@contextmanager
def house_style() -> Iterator[None]:
    """Draw and write with these settings only; what the process has set returns afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)
        yield


def write(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write ``name.png`` and ``name.svg``, the same bytes for the same figure."""
    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    png, svg = io.BytesIO(), io.BytesIO()
    with house_style():
        figure.savefig(png, format="png", dpi=PNG_DPI, metadata={"Software": None})
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    for path, drawn in zip(paths, (png, svg), strict=True):
        replace_public(path, drawn.getvalue())
    return paths


def panels(
    rows: int,
    columns: int,
    *,
    widths: Sequence[float],
    heights: Sequence[float],
    header: float = 0.0,
    side: float = 0.0,
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure of panels, sizes in inches, with room for the legend above or right."""
    width, height = sum(widths), sum(heights)
    engine = ConstrainedLayoutEngine(
        rect=(0, 0, width / (width + side), height / (height + header)), w_pad=0.06, h_pad=0.06
    )
    figure = Figure(figsize=(width + side, height + header), layout=engine)
    axes = figure.subplots(
        rows,
        columns,
        squeeze=False,
        gridspec_kw={"width_ratios": list(widths), "height_ratios": list(heights)},
    )
    return figure, [list(line) for line in axes]


def name_groups(
    axes: Axes, centres: Iterable[tuple[str, float]], *, below: float, **text: Any
) -> None:
    """Write the names of groups of bars below their dimensions, and what these are."""
    for name, centre in centres:
        axes.annotate(
            name,
            (centre, 0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -below),
            textcoords="offset points",
            ha="center",
            va="top",
            annotation_clip=False,
            **text,
        )
    axes.annotate(
        "m =",
        (0, 0),
        xycoords="axes fraction",
        xytext=(-4, -4),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=SMALL_SIZE,
        annotation_clip=False,
    )
