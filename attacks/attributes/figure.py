"""The paper's figure of the privacy experiment: what neighbours tell, and what stronger ones do."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from attacks.outcomes import RAW, KnowledgeLevel
from templates.distances import Metric
from verify.evaluation.figures.style import (
    GROUND,
    HUES,
    INK,
    QUIET,
    RULE,
    SMALL_SIZE,
    house_style,
    name_groups,
    panels,
)
from verify.evaluation.row_labels import order_of

Row = Mapping[str, Any]
Group = tuple[str, str]
Cell = tuple[str, str, int]

BAR_INCHES = 0.3
SIDE_INCHES = 1.3
NARROWEST_INCHES = 8.4
PANEL_INCHES = 2.7
HEADER_INCHES = 0.9
_GAP = 0.9
# Room for a name of a strategy under its bars, in bars.
_LEAST_BARS = 3.4
_HATCHES = ("/////", "", "xxxx", "\\\\\\\\\\", "....", "----")
_MARKS = {
    str(KnowledgeLevel.ALGORITHM): ("D", "strongest attacker, without the decoy pool"),
    str(KnowledgeLevel.DECOYS): ("^", "strongest attacker, with the decoy pool"),
}
_UNIFORM = (0, (1.2, 1.4))
_MAJORITY = (0, (6, 2))


def attribute_figure(rows: Sequence[Row]) -> Figure | None:
    """Draw the accuracy of attribute inference; None without the paper's attacker in the rows.

    One panel for each attribute. Bars are the paper's attacker (K nearest neighbours, Euclidean
    where it was run) with the 95 % interval as whiskers, a group for each strategy with its decoys
    and a bar for each m; the white bar is raw descriptors. A marker over a bar is the attacker that
    was strongest on faces of its own (`attributes.rows.strongest`). Lines are the share of the
    largest class and equal guessing.

    Parameters
    ----------
    rows
        As `AttributeRow.to_json` gives them, of one seed.
    """
    bars = _bars_of(rows)
    if not bars:
        return None
    attributes = list(dict.fromkeys(name for name, _ in bars))
    places, centres, width = _layout(sorted(bars.values(), key=_order))
    marks = _strongest(rows)
    with house_style():
        across = max(NARROWEST_INCHES, width * BAR_INCHES + SIDE_INCHES)
        figure, grid = panels(
            len(attributes),
            1,
            widths=[across],
            heights=[PANEL_INCHES] * len(attributes),
            header=HEADER_INCHES,
        )
        for axes, attribute in zip((line[0] for line in grid), attributes, strict=True):
            attribute_bars = [row for (name, _), row in bars.items() if name == attribute]
            _draw_bars(axes, attribute_bars, places, list(centres))
            for knowledge, (marker, _) in _MARKS.items():
                _draw_marks(axes, attribute, knowledge, marker, marks, places)
            _draw_chance(axes, attribute_bars[0])
            _dress(axes, attribute, places, centres, width)
        _legend(figure, {knowledge for _, _, knowledge in marks})
    return figure


def _cell(row: Row) -> Cell:
    return str(row["strategy"]), str(row.get("decoys") or ""), int(row["dim"])


def _order(row: Row) -> tuple[Any, ...]:
    # The paper's strategies with its pool first, generated decoys last.
    return str(row.get("decoys") or "") == "generator", order_of({"mode": "", **row})


def _bars_of(rows: Sequence[Row]) -> dict[tuple[str, Cell], Row]:
    """The paper's attacker by attribute and scheme, Euclidean rather than spherical."""
    bars: dict[tuple[str, Cell], Row] = {}
    for row in rows:
        key = (str(row["attribute"]), _cell(row))
        if row["attacker"] == "knn" and (key not in bars or row["metric"] == Metric.EUCLIDEAN):
            bars[key] = row
    return bars


def _strongest(rows: Sequence[Row]) -> dict[tuple[str, Cell, str], Row]:
    strongest: dict[tuple[str, Cell, str], Row] = {}
    for row in rows:
        key = (str(row["attribute"]), _cell(row), str(row["knowledge"]))
        if key not in strongest or row["held_out_strength"] > strongest[key]["held_out_strength"]:
            strongest[key] = row
    return strongest


def _layout(rows: Sequence[Row]) -> tuple[dict[Cell, float], dict[Group, float], float]:
    """Where the bars and the names of their groups stand, in widths of a bar."""
    dims: dict[Group, set[int]] = {}
    for row in rows:
        strategy, decoys, dim = _cell(row)
        dims.setdefault((strategy, decoys), set()).add(dim)
    places: dict[Cell, float] = {}
    centres: dict[Group, float] = {}
    edge = 0.0
    for group, present in dims.items():
        width = max(1.6 if group[0] == RAW else _LEAST_BARS, len(present))
        for number, dim in enumerate(sorted(present)):
            places[*group, dim] = edge + (width - len(present)) / 2 + 0.5 + number
        centres[group] = edge + width / 2
        edge += width + _GAP
    return places, centres, edge - _GAP


def _look(group: Group, groups: Sequence[Group]) -> dict[str, Any]:
    """White for raw; else a hue and a hatch of the group's own."""
    lifted = [other for other in groups if other[0] != RAW]
    if group not in lifted:
        return {"facecolor": GROUND, "edgecolor": INK}
    number = lifted.index(group)
    hue = HUES[number % len(HUES)]
    return {
        "facecolor": f"{hue}33",
        "edgecolor": hue,
        "hatch": _HATCHES[number % len(_HATCHES)],
    }


def _draw_bars(
    axes: Axes, rows: Sequence[Row], places: Mapping[Cell, float], groups: Sequence[Group]
) -> None:
    for row in rows:
        strategy, decoys, _ = cell = _cell(row)
        value = 100 * float(row["accuracy"])
        low, high = 100 * float(row["ci_low"]), 100 * float(row["ci_high"])
        axes.bar(
            [places[cell]],
            [value],
            0.8,
            yerr=[[max(0.0, value - low)], [max(0.0, high - value)]],
            error_kw={"ecolor": INK, "elinewidth": 1.0, "capsize": 1.6, "capthick": 1.0},
            linewidth=1.0,
            **_look((strategy, decoys), groups),
        )


def _draw_marks(
    axes: Axes,
    attribute: str,
    knowledge: str,
    marker: str,
    marks: Mapping[tuple[str, Cell, str], Row],
    places: Mapping[Cell, float],
) -> None:
    chosen = {
        cell: 100 * float(row["accuracy"])
        for (name, cell, known), row in marks.items()
        if name == attribute and known == knowledge and cell in places
    }
    axes.plot(
        [places[cell] for cell in chosen],
        list(chosen.values()),
        marker=marker,
        linestyle="none",
        markersize=5.5,
        color=INK,
        markeredgecolor=GROUND,
        markeredgewidth=0.8,
        zorder=6,
    )


def _draw_chance(axes: Axes, row: Row) -> None:
    baselines = row["baselines"]
    for name, dashes in (("majority", _MAJORITY), ("uniform", _UNIFORM)):
        axes.axhline(
            100 * float(baselines[name]), color=INK, linewidth=1.2, linestyle=dashes, zorder=5
        )


def _dress(
    axes: Axes,
    attribute: str,
    places: Mapping[Cell, float],
    centres: Mapping[Group, float],
    width: float,
) -> None:
    axes.set_title(attribute, loc="left")
    axes.set_ylabel("accuracy %")
    axes.set_ylim(0, 104)
    axes.set_yticks(range(0, 101, 20))
    axes.set_xlim(-0.5, width + 0.5)
    axes.grid(axis="y", color=RULE, linewidth=0.8)
    axes.tick_params(axis="x", length=0, pad=2)
    axes.set_xticks(
        list(places.values()), [str(dim) if dim else "" for _, _, dim in places], color=QUIET
    )
    names = [("\n".join(group).rstrip(), centre) for group, centre in centres.items()]
    name_groups(axes, names, below=16, fontsize=SMALL_SIZE + 0.5)


def _legend(figure: Figure, knowledge: set[str]) -> None:
    handles: list[Patch | Line2D] = [
        Patch(facecolor=RULE, edgecolor=QUIET, label="K nearest neighbours (the paper's)")
    ]
    handles += [
        Line2D([], [], color=INK, marker=marker, linestyle="none", markersize=6, label=label)
        for known, (marker, label) in _MARKS.items()
        if known in knowledge
    ]
    for dashes, label in ((_MAJORITY, "largest class"), (_UNIFORM, "equal guessing")):
        handles.append(Line2D([], [], color=INK, linewidth=1.2, linestyle=dashes, label=label))
    figure.legend(handles=handles, loc="upper center", ncols=2, handlelength=2.2, columnspacing=1.4)
