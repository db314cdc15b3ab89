"""`results.json` as a flat CSV and as a report in Markdown."""

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
    RAW,
    Row,
    datasets_of,
    fmr_targets,
    order_of,
    strategy_label,
)

LISTED_FAILURES = 20
HASH_DIGITS = 12
INTERVALS = {"subject-bootstrap": "bootstrap by subject", "pair-bootstrap": "bootstrap of pairs"}
# A spreadsheet runs what begins so; after an apostrophe it is text.
_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
_LEFT = ("strategy", "threshold search", "metric", "matching")


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


def markdown(results: Mapping[str, Any]) -> str:
    """Return the report: where the numbers come from, then tables for each data set.

    It has no date, so that the same run gives the same text.
    """
    names = datasets_of(results)
    parts = [f"# Face verification: {', '.join(map(plain, names))}", _provenance(results)]
    for dataset in results["datasets"]:
        name = dataset["name"]
        parts += [f"## {plain(name)}", *_dataset(dataset)]
        rows = sorted((row for row in results["rows"] if row["dataset"] == name), key=order_of)
        for title, chosen, extra in _kinds(rows):
            if chosen:
                parts += [f"### {title}", _counts(chosen), _row_table(chosen, extra)]
        summaries = [entry for entry in results["group_summaries"] if entry["dataset"] == name]
        groups = [entry for entry in results["groups"] if entry["dataset"] == name]
        if groups:
            parts += ["### By group", GROUPS, *_group_tables(groups, summaries)]
    if results["refused"]:
        parts.append("## Refused targets")
        parts.append("\n".join(f"- {plain(sentence)}" for sentence in results["refused"]))
    parts.append(HOW_TO_READ)
    return "\n\n".join(parts) + "\n"


HOW_TO_READ = """## How to read this

- Accuracy: the threshold is chosen on nine folds and applied to the tenth; ± is the standard deviation over the ten folds, (±) that over seeds of the lifting. A lifted row is compared with raw by the exact search; the grid is the literature's.
- FNMR at FMR: the threshold lets at most that share of impostor pairs through on all folds together; in brackets the 95 % interval (bootstrap by subject where the people are known, else bootstrap of pairs, both never narrower than Wilson's), in parentheses errors (mean over runs) of trials.
- p-to-s compares a raw probe with a lifted template, s-to-s two lifted ones; p-to-s rows average the metrics of lifting either side. m is the dimension of the subspace; the spherical distance uses that embeddings have norm 1.
- Collision floor: the share of impostor pairs expected to share decoys and so to be at distance 0; no threshold brings the FMR below it. Collisions are impostor pairs seen closer than 1e-3.
- Failures to acquire are in none of these rates; FAR and FRR, which count them, thresholds per fold and full precision are in results.csv, single runs in results.json. "-" means not measured."""  # noqa: E501


def _provenance(results: Row) -> str:
    model = results["model"]
    kind, source = ("Model pack", model.get("pack")) if "pack" in model else ("Embeddings", None)
    sha256 = model.get("embedder_sha256") or model.get("sha256")
    source = source or model.get("embeddings")
    lines = [f"{kind}: {plain(source)}, n = {model['n']}, SHA-256 {_short(sha256)}"]
    if results["options"].get("flip"):
        lines.append("Embeddings: of the photo and its mirror image, summed")
    for decoys in results["decoys"]:
        facts = [plain(decoys["kind"]), code(decoys["file"])]
        if decoys["entries"] is not None:
            facts.append(f"{count(decoys['entries'])} entries")
            facts.append("labelled" if decoys["labelled"] else "not labelled")
        lines.append(f"Decoys: {', '.join(facts)}, SHA-256 {_short(decoys['sha256'])}")
    seeds = range(results["seed"], results["seed"] + results["repeats"])
    lines.append(f"Seeds: {', '.join(map(str, seeds))}")
    contracts = {row["contract_id"] for row in results["rows"] if row["contract_id"]}
    if contracts:
        lines.append(f"Contracts: {', '.join(map(_short, sorted(contracts)))}")
    software = results["software"].items()
    lines.append("Software: " + ", ".join(f"{plain(k)} {plain(v)}" for k, v in software))
    return "\n".join(f"- {line}" for line in lines)


def _short(sha256: str | None) -> str:
    return code((sha256 or "")[:HASH_DIGITS])


def _dataset(dataset: Row) -> list[str]:
    facts = [f"{count(dataset['images'])} photos"]
    if dataset["people"] is not None:
        facts.append(f"{count(dataset['people'])} people")
    facts.append(
        f"{count(dataset['pairs'])} pairs ({count(dataset['genuine'])} genuine, "
        f"{count(dataset['impostor'])} impostor)"
    )
    if dataset["aligned"] is not None:
        facts.append("aligned crops" if dataset["aligned"] else "detected and aligned here")
    hashed = [("photos", dataset["pictures_sha256"])]
    hashed += [(code(name), sha256) for name, sha256 in dataset["protocol_files"]]
    sums = ", ".join(f"{name} {_short(sha256)}" for name, sha256 in hashed if sha256)
    lines = [", ".join(facts) + (f"; SHA-256: {sums}." if sums else ".")]
    for decoys in dataset["decoys"]:
        used = [plain(decoys["kind"])]
        if decoys["entries"] is not None:
            used.append(f"{count(decoys['entries'])} entries used")
        if decoys["left_out"]:
            left_out = count(decoys["left_out"])
            used.append(f"{left_out} left out because they resemble people of this set")
        lines.append(f"Decoys: {', '.join(used)}; source {_short(decoys['source_id'])}.")
    lines += [f"Note: {plain(note)}" for note in dataset["notes"]]
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


Column = tuple[str, Callable[[Row], str]]
_NAMES: list[Column] = [
    ("strategy", lambda row: plain(strategy_label(row))),
    ("m", lambda row: str(row["dim"]) if row["dim"] else MISSING),
    ("matching", lambda row: MODE_NAMES[row["mode"]]),
    ("metric", lambda row: METRIC_NAMES[row["metric"]]),
]


def _kinds(rows: Sequence[Row]) -> list[tuple[str, list[Row], list[Column]]]:
    """Return the tables of a data set: title, rows, columns that only this table has."""
    search: Column = ("threshold search", lambda row: plain(row["threshold_search"]))
    floor: Column = ("collision floor %", lambda row: percent(row["collision_floor"]))
    raw = [row for row in rows if row["strategy"] in RAW]
    points, spaces = ([row for row in rows if row["mode"] == mode] for mode in ("p2s", "s2s"))
    return [
        ("Raw embeddings", raw, [search]),
        ("Point to subspace (p-to-s)", points, [_NAMES[1]]),
        (
            "Subspace to subspace (s-to-s)",
            spaces,
            [_NAMES[1], floor, ("collisions seen", _collisions)],
        ),
    ]


def _collisions(row: Row) -> str:
    seen = f"{row['collisions_mean']:,.1f}".removesuffix(".0")
    return f"{seen} of {count(row['n_impostor'])}"


def _counts(rows: Sequence[Row]) -> str:
    """Say what all rows share: trials, runs, kind of interval."""
    runs = sorted({row["runs"] for row in rows})
    parts = [
        f"{count(rows[0]['n_genuine'])} genuine and {count(rows[0]['n_impostor'])} impostor "
        "comparisons",
        f"mean of {' or '.join(map(str, runs))} run{'s' if runs != [1] else ''}",
    ]
    cells = [cell for row in rows for cell in row["fnmr_at_fmr"].values()]
    if cells:
        parts.append(f"intervals: {INTERVALS[cells[0]['interval']]}")
    return "; ".join(parts) + "."


def _row_table(rows: Sequence[Row], extra: Sequence[Column]) -> str:
    columns = [
        _NAMES[0],
        extra[0],
        _NAMES[3],
        ("accuracy %", accuracy),
        ("EER %", lambda row: percent(row["eer"])),
        *((f"FNMR % at FMR {power(target)}", _rate_column(target)) for target in fmr_targets(rows)),
        ("AUC", lambda row: fixed(row["auc"], 5)),
        ("d'", lambda row: fixed(row["d_prime"], 2)),
        *extra[1:],
        ("template bytes", lambda row: count(row["template_bytes"])),
    ]
    return _table(columns, rows)


def _rate_column(target: str) -> Callable[[Row], str]:
    return lambda row: interval_cell(row["fnmr_at_fmr"].get(target))


def _table(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    titles = [title for title, _ in columns]
    lines = [[cell(row) for _, cell in columns] for row in rows]
    return table(titles, lines, [title in _LEFT for title in titles])


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
        parts.append(f"**{plain(attribute)}, threshold at FMR {power(target)}**")
        own = [group for group in groups if _judged_at(group) == (attribute, target)]
        lines = [
            {
                **summary,
                "groups": {g["group"]: g for g in own if order_of(g) == order_of(summary)},
            }
            for summary in sorted(summaries, key=order_of)
            if _judged_at(summary) == (attribute, target)
        ]
        columns = [
            *_NAMES,
            ("worst FMR %", lambda row: _worst(row["worst_fmr"])),
            ("× mean", lambda row: fixed(row["fmr_ratio"], 2)),
            ("worst FNMR %", lambda row: _worst(row["worst_fnmr"])),
            ("× mean", lambda row: fixed(row["fnmr_ratio"], 2)),
        ]
        columns += [
            (f"{plain(name)}: FMR / FNMR %", _group_column(name))
            for name in dict.fromkeys(group["group"] for group in own)
        ]
        parts.append(_table(columns, lines))
    return parts


def _judged_at(entry: Row) -> tuple[str, float]:
    return entry["attribute"], entry["target_fmr"]


def _worst(worst: Row | None) -> str:
    if worst is None:
        return MISSING
    return f"{plain(worst['group'])}: {interval_cell(worst)}{' apart' if worst['apart'] else ''}"


def _group_column(name: str) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        rates = (row["groups"][name][kind] for kind in ("fmr", "fnmr"))
        return " / ".join(
            percent(rate["value"]) + ("" if rate["judged"] or not rate["trials"] else FEW)
            for rate in rates
        )

    return cell
