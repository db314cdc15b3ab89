"""The results table of docs/evaluation.md, made from the ``results.json`` of evaluations.

Every number in it comes from the files, which are of one model, one LFW and the same seeds. Only
LFW is in it and the spherical distance, by which the product decides; ± is the standard deviation
over seeds. With --write the table is put between the two markers of a page.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- evaluation:begin -->", "<!-- evaluation:end -->"
MODES = {"p2s": "p-to-s", "s2s": "s-to-s"}
STRATEGIES = ("random", "adversarial", "hybrid", "hybrid+")

Row = Mapping[str, Any]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("results", type=Path, nargs="+", metavar="RESULTS.json")
    parser.add_argument("--write", type=Path, metavar="PAGE.md")


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return the rows of the table."""
    several = [json.loads(path.read_text(encoding="utf-8")) for path in args.results]
    if args.write is not None:
        page = args.write.read_text(encoding="utf-8")
        args.write.write_text(written_into(page, readme_table(several)), encoding="utf-8")
    return table_rows(several)


def table_rows(several: Sequence[Row]) -> list[dict[str, object]]:
    """Return a row for each strategy and mode, with a column for each m."""
    rows = _lifted(several)
    dims = sorted({int(row["dim"]) for row in rows})
    lines: dict[tuple[Any, ...], dict[int, Row]] = {}
    for row in rows:
        place = list(MODES).index(row["mode"]), STRATEGIES.index(row["strategy"])
        decoys = str(row.get("decoys") or ""), bool(row.get("shared_decoys"))
        lines.setdefault((*place, *decoys), {})[int(row["dim"])] = row
    made = []
    for (mode, strategy, decoys, shared), by_dim in sorted(lines.items()):
        kind = f" ({decoys}{', shared' if shared else ''})" if decoys else ""
        cells: dict[str, object] = {
            "lifting (decoys)": STRATEGIES[strategy] + kind,
            "matching": list(MODES.values())[mode],
        }
        made.append(cells | {f"m = {dim}": _accuracy(by_dim.get(dim)) for dim in dims})
    return made


def readme_table(several: Sequence[Row]) -> str:
    """Return the caption and the table, padded so that it also reads as plain text."""
    rows = table_rows(several)
    titles = list(rows[0])
    lines = [titles, *([str(row[title]) for title in titles] for row in rows)]
    widths = [max(3, *map(len, column)) for column in zip(*lines, strict=True)]
    rule = ["-" * width if i < 2 else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    text = "\n".join(
        "| "
        + " | ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        + " |"
        for line in (titles, rule, *lines[1:])
    )
    return f"{_caption(several)}\n\n{text}"


def written_into(text: str, block: str) -> str:
    """Return a text whose part between the markers is the block."""
    head, rest = text.split(BEGIN)
    _, tail = rest.split(END)
    return f"{head}{BEGIN}\n{block}\n{END}{tail}"


def _lifted(several: Sequence[Row]) -> list[Row]:
    return [
        row
        for results in several
        for row in results["rows"]
        if row["dataset"] == _lfw(results)["name"]
        and row["strategy"] in STRATEGIES
        and row["metric"] == "spherical"
        and row["mode"] in MODES
    ]


def _lfw(results: Row) -> Row:
    return next(
        dict(dataset)
        for dataset in results["datasets"]
        if dataset.get("kind") == "lfw" or str(dataset["name"]).lower() == "lfw"
    )


def _accuracy(row: Row | None) -> str:
    if row is None or row.get("accuracy_mean") is None:
        return "-"
    text, seeds = f"{100 * row['accuracy_mean']:.2f}", row.get("accuracy_std_seeds")
    return text if seeds is None else f"{text} ± {100 * seeds:.2f}"


def _caption(several: Sequence[Row]) -> str:
    first, rows = several[0], _lifted(several)
    dataset, model = _lfw(first), first["model"]
    raw = next(
        row
        for row in first["rows"]
        if (row["dataset"], row["strategy"]) == (dataset["name"], "raw")
        and row.get("threshold_search", "exact") == "exact"
    )
    reference = f"{100 * raw['accuracy_mean']:.2f} %"
    if raw.get("accuracy_std") is not None:
        reference += f" (± {100 * raw['accuracy_std']:.2f} over folds)"
    spread = any(row.get("accuracy_std_seeds") is not None for row in rows)
    seeds = f"mean of {first['repeats']} seeds ± their standard deviation" if spread else "one seed"
    return (
        f"Ten-fold accuracy in % on the {dataset['pairs']:,} pairs of LFW "
        f"({rows[0]['n_genuine']:,} genuine and {rows[0]['n_impostor']:,} impostor compared), "
        f"{model.get('pack') or model.get('embeddings')}, spherical distance, {seeds}. "
        f"Raw embeddings: {reference}."
    )
