"""The paper's figure of the privacy experiment: what neighbours tell, and what stronger ones do."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from attacks.outcomes import RAW, KnowledgeLevel, Scheme
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

Row = Mapping[str, Any]

BAR_INCHES, SIDE_INCHES, NARROWEST_INCHES = 0.3, 1.3, 8.4
PANEL_INCHES, HEADER_INCHES = 2.7, 0.9
_LEAST_BARS = 3.4
"""Room for a name of a strategy under its bars, in bars."""
_MARKS = {
    str(KnowledgeLevel.ALGORITHM): ("D", "strongest attacker, without the decoy pool"),
    str(KnowledgeLevel.DECOYS): ("^", "strongest attacker, with the decoy pool"),
}
_CHANCE = {"majority": ("largest class", (0, (6, 2))), "uniform": ("equal guessing", (0, (1, 1)))}


def attribute_figure(rows: Sequence[Row]) -> Figure | None:
    """Draw the accuracy of attribute inference; None without the paper's attacker in the rows.

    One panel for each attribute. Bars are the paper's attacker (K nearest neighbours, Euclidean
    where it was run) with the 95 % interval as whiskers, a group for each strategy with its decoys
    and a bar for each m; the white bar is raw embeddings. A marker over a bar is the attacker that
    was strongest on faces of its own (`attributes.rows.strongest`). Lines are the share of the
    largest class and equal guessing.

    Parameters
    ----------
    rows
        As `AttributeRow.to_json` gives them, of one seed.
    """
    papers = [row for row in rows if row["attacker"] == "knn"]
    # Of two metrics the Euclidean one comes last, and is kept.
    papers.sort(key=lambda row: row["metric"] == Metric.EUCLIDEAN)
    bars = {(row["attribute"], Scheme.of(row)): row for row in papers}
    if not bars:
        return None
    places, names = _layout(bars.values())
    marks: dict[tuple[str, Scheme, str], Row] = {}
    for row in rows:
        key = (row["attribute"], Scheme.of(row), row["knowledge"])
        if key not in marks or row["held_out_strength"] > marks[key]["held_out_strength"]:
            marks[key] = row
    attributes = list(dict.fromkeys(row["attribute"] for row in rows))
    width = max(places.values()) + 1
    with house_style():
        figure, grid = panels(
            len(attributes),
            1,
            widths=[max(NARROWEST_INCHES, width * BAR_INCHES + SIDE_INCHES)],
            heights=[PANEL_INCHES] * len(attributes),
            header=HEADER_INCHES,
        )
        for (axes,), attribute in zip(grid, attributes, strict=True):
            own = [(bars[attribute, scheme], at) for scheme, at in places.items()]
            _draw_bars(axes, own, [group for group, _ in names])
            for knowledge, (marker, _) in _MARKS.items():
                shown = {
                    at: 100 * marks[attribute, scheme, knowledge]["accuracy"]
                    for scheme, at in places.items()
                    if (attribute, scheme, knowledge) in marks
                }
                axes.plot(
                    list(shown), list(shown.values()), marker, markersize=5.5, color=INK,
                    markeredgecolor=GROUND, markeredgewidth=0.8, zorder=6,
                )  # fmt: skip
            for name, (_, dashes) in _CHANCE.items():
                level = 100 * own[0][0]["baselines"][name]
                axes.axhline(level, color=INK, linewidth=1.2, linestyle=dashes, zorder=5)
            axes.set_title(attribute, loc="left")
            axes.set_ylabel("accuracy %")
            axes.set_ylim(0, 104)
            axes.set_xlim(-1, width)
            axes.grid(axis="y", color=RULE, linewidth=0.8)
            axes.tick_params(axis="x", length=0, pad=2)
            axes.set_xticks(
                list(places.values()), [str(one.dim or "") for one in places], color=QUIET
            )
            name_groups(axes, names, below=16, fontsize=SMALL_SIZE + 0.5)
        figure.legend(
            handles=list(_legend({knowledge for _, _, knowledge in marks})),
            loc="upper center",
            ncols=2,
        )
    return figure


def _layout(rows: Iterable[Row]) -> tuple[dict[Scheme, float], list[tuple[str, float]]]:
    """Where the bars stand, and the names of their groups, in widths of a bar."""
    groups: dict[str, list[Scheme]] = {}
    for row in rows:
        scheme = Scheme.of(row)
        group = groups.setdefault(_group(row), [])
        if scheme not in group:
            group.append(scheme)
    places: dict[Scheme, float] = {}
    names, edge = [], 0.0
    for name, schemes in groups.items():
        width = max(1.0 if name == RAW else _LEAST_BARS, len(schemes))
        first = edge + (width - len(schemes)) / 2
        places |= {scheme: first + number for number, scheme in enumerate(schemes)}
        names.append((name, edge + (width - 1) / 2))
        edge += width + 1
    return places, names


def _group(row: Row) -> str:
    return f"{row['strategy']}\n{row['decoys'] or ''}".rstrip()


def _draw_bars(axes: Axes, bars: Iterable[tuple[Row, float]], groups: Sequence[str]) -> None:
    for row, at in bars:
        group = _group(row)
        hue = INK if group == RAW else HUES[groups.index(group) % len(HUES)]
        value, low, high = (100 * row[name] for name in ("accuracy", "ci_low", "ci_high"))
        axes.bar(
            [at],
            [value],
            0.8,
            yerr=[[max(0.0, value - low)], [max(0.0, high - value)]],
            error_kw={"ecolor": INK, "elinewidth": 1.0, "capsize": 1.6},
            facecolor=GROUND if group == RAW else f"{hue}33",
            edgecolor=hue,
        )


def _legend(knowledge: set[str]) -> Iterable[Patch | Line2D]:
    yield Patch(facecolor=RULE, edgecolor=QUIET, label="K nearest neighbours (the paper's)")
    for known, (marker, label) in _MARKS.items():
        if known in knowledge:
            yield Line2D([], [], color=INK, marker=marker, linestyle="none", label=label)
    for label, dashes in _CHANCE.values():
        yield Line2D([], [], color=INK, linewidth=1.2, linestyle=dashes, label=label)
