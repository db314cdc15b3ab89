"""`results.json` as a flat CSV and as a report in Markdown."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from templates.keys.private_file import replace_public
from verify.evaluation import group_tables
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
    significant,
    table,
)
from verify.evaluation.row_labels import (
    METRIC_NAMES,
    RAW,
    Row,
    datasets_of,
    fmr_targets,
    order_of,
    strategy_label,
    timing_key,
    timings_by_key,
)

LISTED_FAILURES = 20
HASH_DIGITS = 12
INTERVALS = {"subject-bootstrap": "bootstrap by subject", "pair-bootstrap": "bootstrap of pairs"}
# A spreadsheet runs what begins so; after an apostrophe it is text.
_FORMULAS = ("=", "+", "-", "@", "\t", "\r")


def write_csv(results: Mapping[str, Any], path: Path | str) -> None:
    """Write one line per row, by RFC 4180 (commas, CRLF, UTF-8, no byte order mark).

    Nested values become columns of their own: ``fnmr_at_fmr_0.01`` is the rate and
    ``fnmr_at_fmr_0.01_ci_low`` a field beside it; ``thresholds_1`` is that of the first fold. The
    timing of a row follows as ``microseconds_per_comparison`` and ``ratio_to_raw``. Rates are
    fractions, in full precision; what is missing is empty. Text that a spreadsheet would run as a
    formula has an apostrophe before it.
    """
    timings = timings_by_key(results)
    write_lines(
        [_flat(row) | _flat_timing(timings.get(timing_key(row), {})) for row in results["rows"]],
        path,
    )


def write_lines(rows: Sequence[Mapping[str, Any]], path: Path | str) -> None:
    """Write rows, flattened, as :func:`write_csv` does."""
    lines = [_flat(row) for row in rows]
    columns = list(dict.fromkeys(name for line in lines for name in line))
    file = io.StringIO(newline="")
    writer = csv.DictWriter(file, columns, restval="", lineterminator="\r\n")
    writer.writeheader()
    writer.writerows({name: _inert(value) for name, value in line.items()} for line in lines)
    replace_public(Path(path), file.getvalue().encode())


def _inert(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULAS) else value


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return a nested value as columns; the field ``value`` takes the name of its parent."""
    if isinstance(value, Mapping):
        flat: dict[str, Any] = {}
        for key, inner in value.items():
            column = name if key == "value" else f"{name}_{key}" if name else str(key)
            flat |= _flat(inner, column)
        return flat
    if isinstance(value, Sequence) and not isinstance(value, str):
        return {f"{name}_{place}": inner for place, inner in enumerate(value, start=1)}
    if isinstance(value, bool):
        return {name: str(value).lower()}
    return {name: "" if value is None else value}


def _flat_timing(timing: Row) -> dict[str, Any]:
    columns = ("microseconds_per_comparison", "ratio_to_raw")
    return {name: timing[name] for name in columns if name in timing}


def markdown(results: Mapping[str, Any]) -> str:
    """Return the report: where the numbers come from, then tables for each data set.

    It has no date, so that the same run gives the same text.
    """
    names = datasets_of(results)
    stated = {str(dataset["name"]): dataset for dataset in results.get("datasets", ())}
    parts = [f"# Face verification: {', '.join(plain(name) for name in names)}"]
    parts.append(_provenance(results))
    timings = timings_by_key(results)
    for name in names:
        parts.append(f"## {plain(name)}")
        if name in stated:
            parts += _dataset(stated[name])
        rows = sorted((r for r in results["rows"] if r["dataset"] == name), key=order_of)
        for title, chosen, extra in _kinds(rows):
            if chosen:
                parts += [f"### {title}", _counts(chosen), _row_table(chosen, timings, extra)]
        groups, summaries = (
            [entry for entry in results.get(part) or () if entry["dataset"] == name]
            for part in ("groups", "group_summaries")
        )
        parts += group_tables.markdown(groups, summaries)
    if results.get("refused"):
        parts.append("## Refused targets")
        parts.append("\n".join(f"- {plain(sentence)}" for sentence in results["refused"]))
    parts.append(HOW_TO_READ)
    return "\n\n".join(parts) + "\n"


HOW_TO_READ = """## How to read this

- Accuracy: the threshold is chosen on nine folds and applied to the tenth; ± is the standard deviation over the ten folds, (±) that over seeds of the lifting. A lifted row is compared with raw by the exact search; the grid is the literature's.
- FNMR at FMR: the threshold lets at most that share of impostor pairs through on all folds together; in brackets the 95 % interval (bootstrap by subject where the people are known, else bootstrap of pairs, both never narrower than Wilson's), in parentheses errors (mean over runs) of trials.
- p-to-s compares a raw probe with a lifted template, s-to-s two lifted ones; p-to-s rows average the metrics of lifting either side. m is the dimension of the subspace; the spherical distance uses that descriptors have norm 1.
- Collision floor: the share of impostor pairs expected to share decoys and so to be at distance 0; no threshold brings the FMR below it. Collisions are impostor pairs seen closer than 1e-3.
- Failures to acquire are in none of these rates; FAR and FRR, which count them, thresholds per fold and full precision are in results.csv, single runs in results.json. "-" means not measured."""  # noqa: E501


def _provenance(results: Row) -> str:
    model = results.get("model", {})
    lines = []
    source = model.get("pack") or model.get("embeddings")
    sha256 = model.get("embedder_sha256") or model.get("sha256")
    kind = "Model pack" if model.get("pack") else "Embeddings"
    lines.append(f"{kind}: {plain(source)}, n = {plain(model.get('n'))}, SHA-256 {_short(sha256)}")
    if results.get("options", {}).get("flip"):
        lines.append("Embeddings: of the photo and its mirror image, summed")
    for decoys in results.get("decoys") or ():
        facts = [plain(decoys.get("kind")), code(decoys.get("file"))]
        if decoys.get("entries") is not None:
            facts.append(f"{count(decoys['entries'])} entries")
        if decoys.get("labelled") is not None:
            facts.append("labelled" if decoys["labelled"] else "not labelled")
        lines.append(f"Decoys: {', '.join(facts)}, SHA-256 {_short(decoys.get('sha256'))}")
    lines.append(f"Seeds: {_seeds(results)}")
    contracts = {str(row["contract_id"]) for row in results["rows"] if row.get("contract_id")}
    if contracts:
        lines.append(f"Contracts: {', '.join(_short(name) for name in sorted(contracts))}")
    software = results.get("software", {})
    lines.append("Software: " + ", ".join(f"{plain(k)} {plain(v)}" for k, v in software.items()))
    return "\n".join(f"- {line}" for line in lines)


def _short(sha256: Any) -> str:
    return code(str(sha256 or "")[:HASH_DIGITS])


def _seeds(results: Row) -> str:
    seeds = {run["seed"] for run in results.get("runs", ()) if run.get("seed") is not None}
    if seeds:
        return ", ".join(str(seed) for seed in sorted(seeds))
    return f"{plain(results.get('seed'))}, {plain(results.get('repeats'))} repeats"


def _dataset(dataset: Row) -> list[str]:
    people = dataset.get("people")
    facts = [f"{count(dataset.get('images'))} photos"]
    if people is not None:
        facts.append(f"{count(people)} people")
    facts.append(
        f"{count(dataset.get('pairs'))} pairs ({count(dataset.get('genuine'))} genuine, "
        f"{count(dataset.get('impostor'))} impostor)"
    )
    if dataset.get("aligned") is not None:
        facts.append("aligned crops" if dataset["aligned"] else "detected and aligned here")
    hashed = [("photos", dataset.get("pictures_sha256"))]
    hashed += [(code(name), sha256) for name, sha256 in dataset.get("protocol_files") or ()]
    sums = ", ".join(f"{name} {_short(sha256)}" for name, sha256 in hashed if sha256)
    lines = [", ".join(facts) + (f"; SHA-256: {sums}." if sums else ".")]
    lines += [_decoys(decoys) for decoys in dataset.get("decoys") or ()]
    lines += [f"Note: {plain(note)}" for note in dataset.get("notes") or ()]
    failures = dataset.get("failures") or []
    if not failures:
        lines.append("Failures to acquire: none.")
        return lines
    fta = percent(dataset.get("fta"))
    lines.append(
        f"Failures to acquire: {count(len(failures))} photos (FTA {fta} %); "
        f"{count(dataset.get('failed_genuine'))} genuine and "
        f"{count(dataset.get('failed_impostor'))} impostor pairs could not be compared."
    )
    listed = [
        f"- {code(failure.get('image'))}: {plain(failure.get('code'))}, "
        f"{plain(failure.get('reason'))}"
        for failure in failures[:LISTED_FAILURES]
    ]
    if len(failures) > LISTED_FAILURES:
        listed.append(f"- and {count(len(failures) - LISTED_FAILURES)} more, in results.json")
    return [*lines, "\n".join(listed)]


def _decoys(decoys: Row) -> str:
    """Say what was used of a source on this data set."""
    facts = [plain(decoys.get("kind"))]
    if decoys.get("entries") is not None:
        facts.append(f"{count(decoys['entries'])} entries used")
    if decoys.get("left_out"):
        facts.append(
            f"{count(decoys['left_out'])} left out because they resemble people of this set"
        )
    return f"Decoys: {', '.join(facts)}; source {_short(decoys.get('source_id'))}."


Column = tuple[str, Callable[[Row], str]]


def _kinds(rows: Sequence[Row]) -> list[tuple[str, list[Row], list[Column]]]:
    """Return the tables of a data set: title, rows, columns that only this table has."""
    dimension: Column = ("m", lambda row: str(row["dim"]))
    search: Column = ("threshold search", lambda row: plain(row.get("threshold_search")))
    floor: Column = ("collision floor %", lambda row: percent(row.get("collision_floor")))
    seen: Column = ("collisions seen", _collisions)
    return [
        ("Raw embeddings", [r for r in rows if r["strategy"] in RAW], [search]),
        ("Point to subspace (p-to-s)", [r for r in rows if r["mode"] == "p2s"], [dimension]),
        (
            "Subspace to subspace (s-to-s)",
            [r for r in rows if r["mode"] == "s2s"],
            [dimension, floor, seen],
        ),
    ]


def _collisions(row: Row) -> str:
    if row.get("collisions_mean") is None:
        return MISSING
    seen = f"{row['collisions_mean']:,.1f}".removesuffix(".0")
    return f"{seen} of {count(row.get('n_impostor'))}"


def _counts(rows: Sequence[Row]) -> str:
    """Say what all rows share: trials, runs, kind of interval."""
    trials = sorted({(row.get("n_genuine"), row.get("n_impostor")) for row in rows}, key=str)
    pairs = " or ".join(f"{count(g)} genuine and {count(i)} impostor" for g, i in trials)
    runs = sorted({int(row["runs"]) for row in rows if row.get("runs") is not None})
    cells = [cell for row in rows for cell in (row.get("fnmr_at_fmr") or {}).values() if cell]
    kinds = sorted({str(cell["interval"]) for cell in cells if cell.get("interval")})
    parts = [f"{pairs} comparisons"]
    if runs:
        parts.append(f"mean of {' or '.join(map(str, runs))} run{'s' if runs != [1] else ''}")
    if kinds:
        parts.append(
            f"intervals: {' or '.join(INTERVALS.get(kind, plain(kind)) for kind in kinds)}"
        )
    return "; ".join(parts) + "."


def _row_table(
    rows: Sequence[Row], timings: Mapping[tuple[Any, ...], Row], extra: Sequence[Column]
) -> str:
    columns: list[Column] = [
        ("strategy", lambda row: plain(strategy_label(row))),
        extra[0],
        ("metric", lambda row: METRIC_NAMES.get(row["metric"], plain(row["metric"]))),
        ("accuracy %", accuracy),
        ("EER %", lambda row: percent(row.get("eer"))),
    ]
    columns += [
        (f"FNMR % at FMR {power(target)}", _rate_column(target)) for target in fmr_targets(rows)
    ]
    columns += [
        ("AUC", lambda row: fixed(row.get("auc"), 5)),
        ("d'", lambda row: fixed(row.get("d_prime"), 2)),
        *extra[1:],
        ("template bytes", lambda row: count(row.get("template_bytes"))),
        ("µs per comparison (× raw)", lambda row: _time(timings.get(timing_key(row)))),
    ]
    left = [title in ("strategy", "threshold search", "metric") for title, _ in columns]
    return table(
        [title for title, _ in columns], [[cell(row) for _, cell in columns] for row in rows], left
    )


def _rate_column(target: str) -> Callable[[Row], str]:
    return lambda row: interval_cell((row.get("fnmr_at_fmr") or {}).get(target))


def _time(timing: Row | None) -> str:
    if timing is None or timing.get("microseconds_per_comparison") is None:
        return MISSING
    ratio = timing.get("ratio_to_raw")
    times = f" (×{significant(ratio)})" if ratio is not None else ""
    return significant(timing["microseconds_per_comparison"]) + times
