"""Error rates by group of people, after ISO/IEC 19795-10: the worst group named, all beside it."""

from collections.abc import Mapping, Sequence
from typing import Any

from verify.evaluation.markdown_cells import (
    MISSING,
    fixed,
    interval_cell,
    percent,
    plain,
    power,
    table,
)
from verify.evaluation.row_labels import METRIC_NAMES, MODE_NAMES, Row, order_of, strategy_label

FEW = "*"
LEGEND = (
    "FMR and FNMR in each group at the one threshold that holds for all; errors are means over "
    "runs. The worst group has the highest rate of those with trials enough to be judged; apart "
    "says that its interval, widened for the number of groups, lies above the rate of all groups "
    "together. × mean is its rate over the geometric mean of the judged groups. "
    f"{FEW} marks rates of too few trials to be judged."
)


def markdown(groups: Sequence[Row], summaries: Sequence[Row]) -> list[str]:
    """Return one table per attribute and FMR target of one data set; empty where none.

    Parameters
    ----------
    groups, summaries
        Entries of ``groups`` and ``group_summaries`` in `results.json`.
    """
    if not groups:
        return []
    parts = ["### By group", LEGEND]
    known = {(order_of(s), *_target(s)): s for s in summaries}
    for target in dict.fromkeys(_target(group) for group in groups):
        chosen = [group for group in groups if _target(group) == target]
        attribute, fmr = target
        parts.append(f"**{plain(attribute)}, threshold at FMR {power(fmr)}**")
        parts.append(_table(chosen, known))
    return parts


def _target(entry: Row) -> tuple[str, float]:
    return str(entry["attribute"]), float(entry["target_fmr"])


def _table(groups: Sequence[Row], summaries: Mapping[tuple[Any, ...], Row]) -> str:
    names = list(dict.fromkeys(str(group["group"]) for group in groups))
    lines: dict[tuple[Any, ...], dict[str, Row]] = {}
    for group in sorted(groups, key=order_of):
        lines.setdefault(order_of(group), {})[str(group["group"])] = group
    titles = ["strategy", "m", "matching", "metric"]
    titles += ["worst FMR %", "× mean", "worst FNMR %", "× mean"]
    titles += [f"{plain(name)}: FMR / FNMR %" for name in names]
    cells = []
    for key, by_name in lines.items():
        first = next(iter(by_name.values()))
        summary = summaries.get((key, *_target(first)), {})
        cells.append(
            [
                plain(strategy_label(first)),
                str(first["dim"]) if first["dim"] else MISSING,
                MODE_NAMES.get(first["mode"], plain(first["mode"])),
                METRIC_NAMES.get(first["metric"], plain(first["metric"])),
                _worst(summary.get("worst_fmr")),
                fixed(summary.get("fmr_ratio"), 2),
                _worst(summary.get("worst_fnmr")),
                fixed(summary.get("fnmr_ratio"), 2),
                *(_both(by_name.get(name)) for name in names),
            ]
        )
    return table(titles, cells, [title in ("strategy", "matching", "metric") for title in titles])


def _worst(worst: Row | None) -> str:
    if not worst:
        return MISSING
    return f"{plain(worst['group'])}: {interval_cell(worst)}{' apart' if worst['apart'] else ''}"


def _both(group: Row | None) -> str:
    if group is None:
        return MISSING
    return " / ".join(_rate(group.get(name) or {}) for name in ("fmr", "fnmr"))


def _rate(rate: Row) -> str:
    text = percent(rate.get("value"))
    return text if text == MISSING or rate.get("judged", True) else text + FEW
