"""How a row of `results.json` is named in tables and figures."""

from collections.abc import Iterable, Mapping
from typing import Any

Row = Mapping[str, Any]

METRIC_NAMES = {"spherical": "spherical", "euclidean": "Euclidean"}
MODE_NAMES = {"p2p": "raw", "p2s": "p-to-s", "s2s": "s-to-s"}
LIFTED_MODES = ("p2s", "s2s")


def strategy_label(row: Row) -> str:
    """Return the strategy with its decoys, such as ``adversarial (pool, shared)``."""
    if not row.get("decoys"):
        return str(row["strategy"])
    return f"{row['strategy']} ({row['decoys']}{', shared' if row['shared_decoys'] else ''})"


def datasets_of(results: Row) -> list[str]:
    """Return the names of the data sets, in the order in which they were given."""
    return [str(dataset["name"]) for dataset in results["datasets"]]


def raw_row(rows: Iterable[Row], dataset: str) -> Row | None:
    """Return the raw reference of a data set, by the exact sweep.

    The rows of subspaces are swept exactly too, so that the two differ in the lifting only.
    """
    names = {"dataset": dataset, "strategy": "raw", "threshold_search": "exact"}
    return next((row for row in rows if names.items() <= row.items()), None)


def fmr_targets(rows: Iterable[Row]) -> list[str]:
    """Return the FMR targets that any row has, the largest first, as they are spelled there."""
    return sorted({target for row in rows for target in row["fnmr_at_fmr"]}, key=float)[::-1]
