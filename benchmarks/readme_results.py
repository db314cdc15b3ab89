"""The results table of docs/evaluation.md, made from the ``results.json`` of evaluations.

Every number in it comes from the files; the table stands between two markers, so that it can be
made anew without touching the text around it.

Example
-------
::

    python -m benchmarks.readme_results one/results.json two/results.json --write docs/evaluation.md
    python -m benchmarks.readme_results results.json --keep docs/results/lfw.json
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from verify.datasets import DatasetError, faults_in
from verify.evaluation.markdown_cells import MISSING, count, fixed, table
from verify.evaluation.results import FORMAT, VERSION
from verify.evaluation.row_labels import (
    LIFTED_MODES,
    LIFTINGS,
    MODE_NAMES,
    Row,
    order_of,
    raw_row,
    strategy_label,
)

BEGIN, END = "<!-- evaluation:begin -->", "<!-- evaluation:end -->"
NEEDED = ("model", "datasets", "rows")
METRIC = "spherical"
ROW_KEY = (
    *("dataset", "strategy", "decoys", "shared_decoys"),
    *("dim", "mode", "metric", "threshold_search"),
)


def read_results(path: Path | str) -> Mapping[str, Any]:
    """Read ``results.json``.

    Raises
    ------
    DatasetError
        If the file cannot be read, is no evaluation, is of another version or lacks a part.
    """
    try:
        results = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(results, dict) or results.get("format") != FORMAT:
        raise DatasetError(
            f'{path} is no evaluation: expected "format": "{FORMAT}"; give the results.json that '
            "veilface evaluate wrote"
        )
    if results.get("version") != VERSION:
        raise DatasetError(
            f"{path} is version {results.get('version')!r} and this table is made from version "
            f"{VERSION}; run veilface evaluate again"
        )
    if missing := [name for name in NEEDED if not results.get(name)]:
        raise DatasetError(f"{path} lacks {', '.join(missing)}; run veilface evaluate again")
    return results


def merged(several: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Put the rows of evaluations together that differ in the strategies only.

    Returns
    -------
    The first, with the data sets, rows and runs of all. Other parts are those of the first.

    Raises
    ------
    DatasetError
        Listing what differs: the model, the seeds, the name of LFW, photos or pairs of a data
        set, or the numbers of a row that occurs twice.
    """
    first, *others = several
    datasets = {dataset["name"]: dataset for dataset in first["datasets"]}
    rows = {_row_key(row): row for row in first["rows"]}
    faults = []
    for place, results in enumerate(others, start=2):
        if results["model"] != first["model"]:
            faults.append(f"results {place} are of another model")
        if any(results.get(name) != first.get(name) for name in ("seed", "repeats")):
            faults.append(f"results {place} have other seeds")
        if _lfw(results)["name"] != _lfw(first)["name"]:
            faults.append(f"results {place} give LFW another name")
        for dataset in results["datasets"]:
            known = datasets.setdefault(dataset["name"], dataset)
            if any(known.get(n) != dataset.get(n) for n in ("pictures_sha256", "protocol_files")):
                faults.append(f"results {place} have other photos or pairs of {dataset['name']}")
        for row in results["rows"]:
            if rows.setdefault(_row_key(row), row) != row:
                name = f"{strategy_label(row)}, m = {row['dim']}, {row['mode']}, {row['metric']}"
                faults.append(f"results {place} have other numbers of {row['dataset']}: {name}")
    if faults:
        raise DatasetError(
            faults_in(Path("the list of results"), "expected those of one set-up", faults)
        )
    runs = [run for results in several for run in results.get("runs") or ()]
    return {
        **first,
        "datasets": list(datasets.values()),
        "rows": list(rows.values()),
        **({"runs": runs} if runs else {}),
    }


def _row_key(row: Row) -> tuple[Any, ...]:
    return tuple(row.get(name) for name in ROW_KEY)


def readme_table(results: Mapping[str, Any]) -> str:
    """Return the table: a line for each strategy and mode, a column for each m.

    Only LFW and the spherical distance, by which the product decides; ± is the standard deviation
    over seeds. The caption states raw embeddings, pairs, runs and the model.

    Raises
    ------
    DatasetError
        Listing what the results lack: LFW, its raw row, spherical rows of liftings.
    """
    dataset = _lfw(results)
    name = str(dataset["name"])
    rows = [
        row
        for row in results["rows"]
        if row["dataset"] == name
        and row["strategy"] in LIFTINGS
        and row["metric"] == METRIC
        and row["mode"] in LIFTED_MODES
    ]
    raw = raw_row(results["rows"], name)
    faults = []
    if raw is None or raw.get("accuracy_mean") is None:
        faults.append("no raw row (add raw to --strategy)")
    if not rows:
        faults.append("no spherical rows of a lifting (add spherical to --metric)")
    if faults or raw is None:
        raise DatasetError(f"the README's table cannot be made, {name} has {'; '.join(faults)}")
    dims = sorted({int(row["dim"]) for row in rows})
    lines: dict[tuple[str, str], dict[int, Row]] = {}
    for row in sorted(rows, key=lambda row: (LIFTED_MODES.index(row["mode"]), order_of(row))):
        lines.setdefault((strategy_label(row), str(row["mode"])), {})[int(row["dim"])] = row
    cells = [
        [label, MODE_NAMES[mode], *(_accuracy(by_dim.get(dim)) for dim in dims)]
        for (label, mode), by_dim in lines.items()
    ]
    titles = ["lifting (decoys)", "matching", *(f"m = {dim}" for dim in dims)]
    return f"{_caption(results, dataset, raw, rows)}\n\n" + table(
        titles, cells, [True, True, *(False for _ in dims)]
    )


def _lfw(results: Row) -> Row:
    for dataset in results["datasets"]:
        if dataset.get("kind") == "lfw" or str(dataset.get("name")).lower() == "lfw":
            return dict(dataset)
    names = ", ".join(str(dataset.get("name")) for dataset in results["datasets"])
    raise DatasetError(
        f"the README's table is about LFW, and the results are about {names}; run veilface "
        "evaluate on LFW"
    )


def _accuracy(row: Row | None) -> str:
    if row is None or row.get("accuracy_mean") is None:
        return MISSING
    text = fixed(100 * row["accuracy_mean"], 2)
    seeds = row.get("accuracy_std_seeds")
    return text if seeds is None else f"{text} ± {fixed(100 * seeds, 2)}"


def _caption(results: Row, dataset: Row, raw: Row, rows: Sequence[Row]) -> str:
    model = results["model"]
    runs = results.get("runs") or ()
    seeds = {
        run["seed"]
        for run in runs
        if run.get("mode") in LIFTED_MODES and run.get("seed") is not None
    }
    number = len(seeds) or int(results.get("repeats") or 1)
    several = any(row.get("accuracy_std_seeds") is not None for row in rows)
    spread = "± their standard deviation" if several else ""
    mean = f"mean of {number} seeds {spread}".rstrip() if number > 1 else "one seed"
    reference = f"{fixed(100 * raw['accuracy_mean'], 2)} %"
    if raw.get("accuracy_std") is not None:
        reference += f" (± {fixed(100 * raw['accuracy_std'], 2)} over folds)"
    return (
        f"Ten-fold accuracy in % on the {count(dataset.get('pairs'))} pairs of LFW "
        f"({count(rows[0].get('n_genuine'))} genuine and {count(rows[0].get('n_impostor'))} "
        f"impostor compared), {model.get('pack') or model.get('embeddings')}, spherical distance, "
        f"{mean}. Raw embeddings: {reference}."
    )


def kept(results: Mapping[str, Any]) -> str:
    """Return the results as they are kept in the repository: rows without single runs."""
    parts = []
    for name, value in results.items():
        if name in ("runs", "curves"):
            continue
        text = json.dumps(value, ensure_ascii=False)
        if isinstance(value, list):
            entries = ",\n  ".join(json.dumps(entry, ensure_ascii=False) for entry in value)
            text = f"[\n  {entries}\n ]"
        parts.append(f" {json.dumps(name)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def written_into(text: str, block: str) -> str:
    """Return a text whose part between the markers is the block.

    Raises
    ------
    DatasetError
        If the markers are not there exactly once and in order.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise DatasetError(f"expected {BEGIN} and then {END} in the text, each once")
    head, rest = text.split(BEGIN)
    return f"{head}{BEGIN}\n{block}\n{END}{rest.split(END)[1]}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, or write it into a page; 0, or 1 with the reason on stderr."""
    parser = argparse.ArgumentParser(description="Make the results table of docs/evaluation.md.")
    parser.add_argument(
        "results", type=Path, nargs="+", metavar="RESULTS.json", help="of one model and one LFW"
    )
    parser.add_argument("--write", type=Path, metavar="PAGE.md")
    parser.add_argument(
        "--keep",
        type=Path,
        nargs="+",
        metavar="COPY.json",
        help="one copy of each RESULTS.json, without runs and curves",
    )
    options = parser.parse_args(arguments)
    copies = options.keep or []
    if copies and len(copies) != len(options.results):
        parser.error(f"--keep needs {len(options.results)} paths, one for each RESULTS.json")
    try:
        several = [read_results(path) for path in options.results]
        block = readme_table(merged(several))
        for results, copy in zip(several, copies, strict=False):
            copy.write_text(kept(results), encoding="utf-8")
        if options.write is None:
            print(block)
            return 0
        text = options.write.read_text(encoding="utf-8")
        options.write.write_text(written_into(text, block), encoding="utf-8")
    except (DatasetError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
