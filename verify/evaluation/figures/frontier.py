"""Privacy against accuracy: what an attacker learns from a template, and what that costs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from verify.datasets import DatasetError, faults_in
from verify.evaluation.figures.style import (
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
    raw_row,
    strategy_label,
)

AUDIT_FORMAT = "veilface audit"
FIELDS: Mapping[str, type | tuple[type, ...]] = {
    "strategy": str,
    "decoys": (str, type(None)),
    "dim": int,
    "attribute": str,
    "attacker": str,
    "accuracy": (int, float),
    "chance": (int, float),
}
KNOWLEDGE = ("algorithm", "template")
"""Of the attackers that count, where a row says what its attacker has: a pool is a secret, and who
holds it strips every decoy."""
MAX_TEXT = 64
MAX_ATTRIBUTES = 16
MAX_DIM = 2**16
PANEL_INCHES = (4.6, 3.7)
SIDE_INCHES = 2.6
Key = tuple[str, str | None, int]


def strongest_attackers(audit: Mapping[str, Any]) -> dict[tuple[Key, str], Row]:
    """Return the strongest attacker of each configuration and attribute.

    Parameters
    ----------
    audit
        The report of `veilface audit fairface`: ``format`` and ``rows``, each with the strategy,
        decoys, dim, attribute, attacker, accuracy and chance (fractions); attackers whose
        ``knowledge`` includes the secret decoys do not count.

    Returns
    -------
    By ((strategy, decoys, dim), attribute).

    Raises
    ------
    DatasetError
        Listing every row that lacks a field or has a value of another kind or range, and where
        there are too many attributes for a figure.
    """
    _validate(audit)
    strongest: dict[tuple[Key, str], Row] = {}
    for row in audit["rows"]:
        if row.get("knowledge", KNOWLEDGE[0]) not in KNOWLEDGE:
            continue
        key = (_key(row), str(row["attribute"]))
        if key not in strongest or _strength(row) > _strength(strongest[key]):
            strongest[key] = row
    return strongest


def _strength(row: Row) -> float:
    """What the strongest is chosen by: on faces of the attacker's own, where the row has that."""
    return float(row.get("held_out_strength", row["accuracy"]))


def _validate(audit: Any) -> None:
    if not isinstance(audit, Mapping) or audit.get("format") != AUDIT_FORMAT:
        raise DatasetError(
            f'not an audit report: expected "format": "{AUDIT_FORMAT}"; give the report.json of '
            "veilface audit fairface"
        )
    rows = audit.get("rows")
    if not isinstance(rows, list) or not rows:
        raise DatasetError("the audit report has no rows; run veilface audit fairface again")
    faults = [f"row {place}: {fault}" for place, row in enumerate(rows) for fault in _faults(row)]
    if not faults:
        attributes = {row["attribute"] for row in rows}
        if len(attributes) > MAX_ATTRIBUTES:
            faults = [f"{len(attributes)} attributes, and {MAX_ATTRIBUTES} are the most"]
    if faults:
        raise DatasetError(
            faults_in(Path("the audit report"), "expected rows that can be drawn", faults)
        )


def _faults(row: Any) -> list[str]:
    if not isinstance(row, Mapping):
        return ["is not an object"]
    missing = [name for name in FIELDS if name not in row]
    faults = [f"lacks {', '.join(missing)}"] if missing else []
    for name, kind in FIELDS.items():
        if name in row and (not isinstance(row[name], kind) or isinstance(row[name], bool)):
            faults.append(f"{name} is {type(row[name]).__name__}")
        elif name in row and (fault := _fault_of(name, row[name])):
            faults.append(fault)
    return faults


def _fault_of(name: str, value: Any) -> str:
    """Return what is wrong with a value of the right kind, empty where nothing is."""
    if isinstance(value, str):
        if len(value) > MAX_TEXT or not value.isprintable():
            return f"{name} is not printable text of at most {MAX_TEXT} characters"
    elif name in ("accuracy", "chance"):
        # What is no number compares false.
        if not 0 <= value <= 1:
            return f"{name} is {str(value)[:20]}, expected a fraction from 0 to 1"
    elif name == "dim" and not 0 <= value <= MAX_DIM:
        return f"dim is {str(value)[:20]}, expected 0 to {MAX_DIM}"
    return ""


def _key(row: Row) -> Key:
    return str(row["strategy"]), row.get("decoys"), int(row["dim"])


def frontier_figure(results: Mapping[str, Any], audit: Mapping[str, Any]) -> Figure | None:
    """Draw verification accuracy over the accuracy of the strongest attacker.

    One panel for each data set and mode (rows) and attribute (columns); a line for each strategy
    with its decoys, a marker for each m that grows with it. Left is private, up is accurate; the
    vertical line is chance, the horizontal one the accuracy of raw descriptors. The metric is
    spherical where it was run. None where no configuration is in both files.

    Raises
    ------
    DatasetError
        If the audit report is not one or lacks fields.
    """
    strongest = strongest_attackers(audit)
    attributes = list(dict.fromkeys(attribute for _, attribute in strongest))
    lines: list[tuple[str, str, list[Row]]] = []
    for name in datasets_of(results):
        for mode in LIFTED_MODES:
            rows = [
                row
                for row in results["rows"]
                if row["dataset"] == name
                and row["mode"] == mode
                and row.get("accuracy_mean") is not None
                and any((_key(row), attribute) in strongest for attribute in attributes)
            ]
            metric = preferred_metric(rows)
            rows = sorted((row for row in rows if row["metric"] == metric), key=order_of)
            if rows:
                lines.append((name, mode, rows))
    if not lines:
        return None
    labels = list(dict.fromkeys(strategy_label(row) for _, _, rows in lines for row in rows))
    looks: dict[str, dict[str, Any]] = {
        label: {"color": HUES[i % len(HUES)], "marker": MARKERS[i % len(MARKERS)]}
        for i, label in enumerate(labels)
    }
    dims = sorted({int(row["dim"]) for _, _, rows in lines for row in rows})
    sizes = {dim: 6.0 + 7.0 * i / max(1, len(dims) - 1) for i, dim in enumerate(dims)}
    with house_style():
        figure, grid = panels(
            len(lines),
            len(attributes),
            widths=[PANEL_INCHES[0]] * len(attributes),
            heights=[PANEL_INCHES[1]] * len(lines),
            side=SIDE_INCHES,
        )
        for place, (name, mode, rows) in enumerate(lines):
            for axes, attribute in zip(grid[place], attributes, strict=True):
                _panel(axes, rows, attribute, strongest, looks, sizes)
                _references(axes, raw_row(results["rows"], name), attribute, strongest)
                metric_name = METRIC_NAMES[rows[0]["metric"]]
                axes.set_title(f"{name}, {MODE_NAMES[mode]}, {metric_name}", loc="left")
                axes.set_xlabel(f"{attribute}: accuracy of the strongest attacker %")
                axes.grid(color=RULE, linewidth=0.8)
                axes.margins(0.1, 0.12)
            grid[place][0].set_ylabel("verification accuracy %")
        handles = [
            Line2D([], [], **looks[label], label=label, linewidth=1.3, markersize=8)
            for label in labels
        ]
        handles += [
            Line2D([], [], color=QUIET, marker="o", linestyle="none", label=f"m = {dim}")
            for dim in sizes
        ]
        for handle, size in zip(handles[len(labels) :], sizes.values(), strict=True):
            handle.set_markersize(size)
        handles.append(Line2D([], [], color=QUIET, linestyle=(0, (1.2, 1.4)), label="chance"))
        handles.append(Line2D([], [], color=INK, linestyle=(0, (6, 2)), marker="*", label="raw"))
        side_legend(figure, handles, SIDE_INCHES)
    return figure


def _panel(
    axes: Axes,
    rows: Sequence[Row],
    attribute: str,
    strongest: Mapping[tuple[Key, str], Row],
    looks: Mapping[str, dict[str, Any]],
    sizes: Mapping[int, float],
) -> None:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if (_key(row), attribute) in strongest:
            groups.setdefault(strategy_label(row), []).append(row)
    for label, group in groups.items():
        x = [100 * float(strongest[_key(row), attribute]["accuracy"]) for row in group]
        y = [100 * float(row["accuracy_mean"]) for row in group]
        axes.plot(x, y, color=looks[label]["color"], linewidth=1.3, label=label)
        for row, across, up in zip(group, x, y, strict=True):
            axes.plot(
                [across],
                [up],
                **looks[label],
                linestyle="none",
                markersize=sizes[int(row["dim"])],
                markeredgecolor="white",
            )


def _references(
    axes: Axes, raw: Row | None, attribute: str, strongest: Mapping[tuple[Key, str], Row]
) -> None:
    chances = [
        100 * float(row["chance"]) for (_, name), row in strongest.items() if name == attribute
    ]
    axes.axvline(
        max(chances), color=QUIET, linewidth=1.3, linestyle=(0, (1.2, 1.4)), label="chance"
    )
    if raw is None or raw.get("accuracy_mean") is None:
        return
    value = 100 * float(raw["accuracy_mean"])
    axes.axhline(value, color=INK, linewidth=1.2, linestyle=(0, (6, 2)), label="raw")
    attacked = strongest.get((("raw", None, 0), attribute))
    if attacked is not None:
        axes.plot(
            [100 * float(attacked["accuracy"])],
            [value],
            marker="*",
            markersize=14,
            color=INK,
            linestyle="none",
            zorder=5,
        )
