"""What an evaluation found: cells of a table, a flat CSV, and a report in Markdown."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from templates.keys.private_file import replace_public
from verify.evaluation.markdown_cells import (
    MISSING,
    accuracy,
    code,
    count,
    fixed,
    interval_cell,
    percent,
    plain,
    power,
    table,
)
from verify.evaluation.row_labels import (
    METRIC_NAMES,
    MODE_NAMES,
    Row,
    datasets_of,
    fmr_targets,
    strategy_label,
)

LISTED_FAILURES = 20
INTERVALS = {"subject-bootstrap": "bootstrap by subject", "pair-bootstrap": "bootstrap of pairs"}
# A spreadsheet runs what begins so; after an apostrophe it is text.
_FORMULAS = ("=", "+", "-", "@", "\t", "\r")

Column = tuple[str, Callable[[Row], str]]
Cells = tuple[list[str], list[list[str]]]
"""Titles, and a line for each row."""


def write_csv(rows: Sequence[Mapping[str, Any]], path: Path | str) -> None:
    """Write one line per row, by RFC 4180 (commas, CRLF, UTF-8, no byte order mark).

    Nested values become columns of their own: ``fnmr_at_fmr_0.01`` is the rate and
    ``fnmr_at_fmr_0.01_ci_low`` a field beside it; ``thresholds_1`` is that of the first fold.
    Rates are fractions, in full precision; what is missing is empty. Text that a spreadsheet would
    run as a formula has an apostrophe before it.
    """
    # Imported here: the report in Markdown is written without it.
    import pandas as pd

    frame = pd.DataFrame(list(map(_flat, rows)), dtype=object)
    text = frame.map(_inert).to_csv(index=False, lineterminator="\r\n")
    replace_public(Path(path), text.encode())


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return a nested value as columns; the field ``value`` takes the name of its parent."""
    if isinstance(value, list | tuple):
        value = dict(enumerate(value, start=1))
    if not isinstance(value, Mapping):
        return {name: value}
    flat: dict[str, Any] = {}
    for key, inner in value.items():
        flat |= _flat(inner, name if key == "value" else f"{name}_{key}" if name else str(key))
    return flat


def _inert(value: Any) -> Any:
    if isinstance(value, bool):
        return str(value).lower()
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULAS) else value


_NAMES: list[Column] = [
    ("strategy", lambda row: plain(strategy_label(row) + _search(row))),
    ("m", lambda row: str(row["dim"]) if row["dim"] else MISSING),
    ("matching", lambda row: MODE_NAMES[row["mode"]]),
    ("metric", lambda row: METRIC_NAMES[row["metric"]]),
]


def row_cells(rows: Sequence[Row]) -> Cells:
    """Say what was compared, its accuracy and its error rates."""
    targets = [
        (f"FNMR % at FMR {power(target)}", lambda row, t=target: _fnmr(row, t))
        for target in fmr_targets(rows)
    ]
    columns = [
        *_NAMES,
        ("accuracy %", accuracy),
        ("EER %", lambda row: percent(row["eer"])),
        *targets,
    ]
    return _cells(columns, rows)


def _search(row: Row) -> str:
    return " (grid)" if row.get("threshold_search") == "grid" else ""


def _fnmr(row: Row, target: str) -> str:
    return interval_cell(row["fnmr_at_fmr"].get(target))


def _cells(columns: Sequence[Column], rows: Sequence[Row]) -> Cells:
    return [title for title, _ in columns], [[cell(row) for _, cell in columns] for row in rows]


def markdown(results: Mapping[str, Any]) -> str:
    """Return the report: where the numbers come from, then what each data set shows.

    It has no date, so that the same run gives the same text.
    """
    names = datasets_of(results)
    parts = [f"# Face verification: {', '.join(map(plain, names))}", _provenance(results)]
    for dataset in results["datasets"]:
        name = dataset["name"]
        rows, summaries, groups = (
            [row for row in results[part] if row["dataset"] == name]
            for part in ("rows", "group_summaries", "groups")
        )
        parts += [f"## {plain(name)}", *_dataset(dataset, rows)]
        parts.append(_table(*row_cells(rows)))
        if groups:
            parts += ["### By group", GROUPS, *_group_tables(groups, summaries)]
    if results["refused"]:
        parts.append("## Refused targets")
        parts.append("\n".join(f"- {plain(sentence)}" for sentence in results["refused"]))
    parts.append(HOW_TO_READ)
    return "\n\n".join(parts) + "\n"


def _table(titles: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    left = {title for title, _ in _NAMES} - {"m"}
    return table(titles, lines, [title in left for title in titles])


HOW_TO_READ = """## How to read this

- Accuracy: the threshold is chosen on nine folds and applied to the tenth; ± is the standard deviation over the ten folds, (±) that over seeds of the lifting. A lifted row is compared with raw by the exact search; the grid is the literature's.
- FNMR at FMR: the threshold lets at most that share of impostor pairs through on all folds together; in brackets the 95 % interval (bootstrap by subject where the people are known, else bootstrap of pairs, both never narrower than Wilson's), in parentheses errors (mean over runs) of trials.
- p-to-s compares a raw probe with a lifted template, s-to-s two lifted ones; p-to-s rows average the metrics of lifting either side. m is the dimension of the subspace; the spherical distance uses that embeddings have norm 1.
- Failures to acquire are in none of these rates. Full precision is in results.csv, single runs with their folds in results.json. "-" means not measured."""  # noqa: E501


def _provenance(results: Row) -> str:
    """Where the numbers come from; hashes and versions are in results.json."""
    model = results["model"]
    source = plain(model.get("pack") or model.get("embeddings"))
    flip = ", of the photo and its mirror image" if results["options"].get("flip") else ""
    seeds = range(results["seed"], results["seed"] + results["repeats"])
    lines = [
        f"Embeddings: {source}, n = {model['n']}{flip}",
        *(f"Decoys: {code(decoys['file'])}, {_decoys(decoys)}" for decoys in results["decoys"]),
        f"Seeds: {', '.join(map(str, seeds))}",
        f"Software: veilface {plain(results['software']['veilface'])}",
    ]
    return "\n".join(f"- {line}" for line in lines)


def _decoys(decoys: Row) -> str:
    entries = "" if decoys["entries"] is None else f" of {count(decoys['entries'])} entries"
    return plain(decoys["kind"]) + entries + (", labelled" if decoys.get("labelled") else "")


def _dataset(dataset: Row, rows: Sequence[Row]) -> list[str]:
    aligned = {None: "", True: ", aligned crops", False: ", detected and aligned here"}
    people = "" if dataset["people"] is None else f", {count(dataset['people'])} people"
    lines = [
        f"{count(dataset['images'])} photos{people}{aligned[dataset['aligned']]}; "
        f"{count(rows[0]['n_genuine'])} genuine and {count(rows[0]['n_impostor'])} impostor "
        f"comparisons of {count(dataset['pairs'])} pairs.",
    ]
    kinds = {INTERVALS[at["interval"]] for row in rows for at in row["fnmr_at_fmr"].values()}
    lines += [f"Intervals: {kind}." for kind in kinds]
    lines += [
        f"Decoys left out that resemble people of this set: {count(decoys['left_out'])}."
        for decoys in dataset["decoys"]
        if decoys["left_out"]
    ]
    failures = dataset["failures"]
    if not failures:
        return [*lines, "Failures to acquire: none."]
    lines.append(
        f"Failures to acquire: {count(len(failures))} photos (FTA {percent(dataset['fta'])} %); "
        f"{count(dataset['failed_genuine'])} genuine and "
        f"{count(dataset['failed_impostor'])} impostor pairs could not be compared."
    )
    return [*lines, failure_list(failures)]


def failure_list(failures: Sequence[Row]) -> str:
    """List the first failures to acquire, and how many more there are."""
    listed = [
        f"- {code(failure['image'])}: {plain(failure['code'])}, {plain(failure['reason'])}"
        for failure in failures[:LISTED_FAILURES]
    ]
    if len(failures) > LISTED_FAILURES:
        listed.append(f"- and {count(len(failures) - LISTED_FAILURES)} more, in results.json")
    return "\n".join(listed)


FEW = "*"
GROUPS = (
    "FMR and FNMR in each group at the one threshold that holds for all; errors are means over "
    "runs. The worst group has the highest rate of those with trials enough to be judged; apart "
    "says that its interval, widened for the number of groups, lies above the rate of all groups "
    "together. × mean is its rate over the geometric mean of the judged groups. "
    f"{FEW} marks rates of too few trials to be judged."
)


def _group_tables(groups: Sequence[Row], summaries: Sequence[Row]) -> list[str]:
    """Return one table for each attribute and FMR target of one data set."""
    parts = []
    for attribute, target in dict.fromkeys(map(_judged_at, groups)):
        own = [group for group in groups if _judged_at(group) == (attribute, target)]
        lines = [
            {**summary, "groups": {g["group"]: g for g in own if _cell(g) == _cell(summary)}}
            for summary in summaries
            if _judged_at(summary) == (attribute, target)
        ]
        columns: list[Column] = [
            *_NAMES,
            ("worst FMR %", lambda row: _worst(row["worst_fmr"])),
            ("× mean", lambda row: fixed(row["fmr_ratio"], 2)),
            ("worst FNMR %", lambda row: _worst(row["worst_fnmr"])),
            ("× mean", lambda row: fixed(row["fnmr_ratio"], 2)),
            *(
                (f"{plain(name)}: FMR / FNMR %", lambda row, n=name: _group_cell(row["groups"][n]))
                for name in dict.fromkeys(group["group"] for group in own)
            ),
        ]
        title = f"**{plain(attribute)}, threshold at FMR {power(target)}**"
        outside = count(lines[0]["without_common_label"])
        parts += [title, _table(*_cells(columns, lines))]
        parts.append(f"Pairs without a common label, which are in no group: {outside}.")
    return parts


def _judged_at(entry: Row) -> tuple[str, float]:
    return entry["attribute"], entry["target_fmr"]


def _cell(entry: Row) -> list[Any]:
    """What was compared, of the rows of one data set."""
    return [entry[name] for name in ("strategy", "decoys", "dim", "mode", "metric")]


def _worst(worst: Row | None) -> str:
    if worst is None:
        return MISSING
    return f"{plain(worst['group'])}: {interval_cell(worst)}{' apart' if worst['apart'] else ''}"


def _group_cell(group: Row) -> str:
    return " / ".join(
        percent(rate["value"]) + ("" if rate["judged"] or not rate["trials"] else FEW)
        for rate in (group["fmr"], group["fnmr"])
    )
