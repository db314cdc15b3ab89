"""The results table of the README, made from an evaluation's ``results.json``.

Every number in it comes from the file; the table stands between two markers, so that it can be
made anew without touching the text around it.

Example
-------
::

    python -m benchmarks.readme_results results.json --write README.md --keep docs/results/lfw.json
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from verify.datasets import DatasetError
from verify.evaluation.markdown_cells import MISSING, count, fixed, table
from verify.evaluation.row_labels import LIFTINGS, Row, order_of, raw_row, strategy_label

FORMAT, VERSION = "veilface evaluation", 1
BEGIN, END = "<!-- evaluation:begin -->", "<!-- evaluation:end -->"
NEEDED = ("model", "datasets", "rows")
METRIC = "spherical"
MODES = {"p2s": "p-to-s", "s2s": "s-to-s"}


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


def readme_table(results: Mapping[str, Any]) -> str:
    """Return the table: a line for each strategy and mode, a column for each m.

    Only LFW and the spherical distance, by which the product decides; ± is the standard deviation
    over seeds. The caption states raw descriptors, pairs, runs and the model.

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
        and row["mode"] in MODES
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
    for row in sorted(rows, key=lambda row: (tuple(MODES).index(row["mode"]), order_of(row))):
        lines.setdefault((strategy_label(row), str(row["mode"])), {})[int(row["dim"])] = row
    cells = [
        [label, MODES[mode], *(_accuracy(by_dim.get(dim)) for dim in dims)]
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
    return f"{text} ± {fixed(100 * seeds, 2)}" if seeds else text


def _caption(results: Row, dataset: Row, raw: Row, rows: Sequence[Row]) -> str:
    model = results["model"]
    runs = results.get("runs") or ()
    seeds = {
        run["seed"] for run in runs if run.get("mode") in MODES and run.get("seed") is not None
    }
    number = len(seeds) or int(results.get("repeats") or 1)
    spread = "± their standard deviation" if any(r.get("accuracy_std_seeds") for r in rows) else ""
    mean = f"mean of {number} seeds {spread}".rstrip() if number > 1 else "one seed"
    reference = f"{fixed(100 * raw['accuracy_mean'], 2)} %"
    if raw.get("accuracy_std") is not None:
        reference += f" (± {fixed(100 * raw['accuracy_std'], 2)} over folds)"
    return (
        f"Ten-fold accuracy in % on the {count(dataset.get('pairs'))} pairs of LFW "
        f"({count(rows[0].get('n_genuine'))} genuine and {count(rows[0].get('n_impostor'))} "
        f"impostor compared), {model.get('pack') or model.get('embeddings')}, spherical distance, "
        f"{mean}. Raw descriptors: {reference}."
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
    """Print the table, or write it into a README; 0, or 1 with the reason on stderr."""
    parser = argparse.ArgumentParser(description="Make the README's results table.")
    parser.add_argument("results", type=Path, metavar="RESULTS.json")
    parser.add_argument("--write", type=Path, metavar="README.md")
    parser.add_argument("--keep", type=Path, metavar="COPY.json", help="without runs and curves")
    options = parser.parse_args(arguments)
    try:
        results = read_results(options.results)
        block = readme_table(results)
        if options.keep is not None:
            options.keep.write_text(kept(results), encoding="utf-8")
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
