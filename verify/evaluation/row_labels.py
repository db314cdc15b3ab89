"""How a row of `results.json` is named and ordered."""

from collections.abc import Iterable, Mapping
from typing import Any

from templates.space.lifting import Strategy

Row = Mapping[str, Any]

RAW = ("raw", "raw+flip")
LIFTINGS = tuple(strategy.value for strategy in Strategy)
ORDER = RAW + LIFTINGS
METRIC_NAMES = {"spherical": "spherical", "euclidean": "Euclidean"}
MODE_NAMES = {"p2p": "raw", "p2s": "p-to-s", "s2s": "s-to-s"}
LIFTED_MODES = ("p2s", "s2s")
PREFERRED_METRICS = ("spherical", "euclidean")


def decoys_label(row: Row) -> str:
    """Return what the decoys of a row are, empty where it has none."""
    kind = str(row.get("decoys") or "")
    return f"{kind}, shared" if kind and row.get("shared_decoys") else kind


def strategy_label(row: Row) -> str:
    """Return the strategy with its decoys, such as ``adversarial (pool, shared)``."""
    decoys = decoys_label(row)
    return f"{row['strategy']} ({decoys})" if decoys else str(row["strategy"])


def order_of(row: Row) -> tuple[Any, ...]:
    """Sort key: strategies in the paper's order, then decoys, dimension and metric."""
    strategy = str(row["strategy"])
    known = ORDER.index(strategy) if strategy in ORDER else len(ORDER)
    return (
        known,
        strategy,
        str(row.get("decoys") or ""),
        bool(row.get("shared_decoys")),
        int(row["dim"]),
        str(row["mode"]),
        str(row["metric"]),
        str(row.get("threshold_search", "")),
    )


def datasets_of(results: Row) -> list[str]:
    """Return the names of the data sets, in the order in which they were given."""
    stated = [str(dataset["name"]) for dataset in results.get("datasets", ())]
    return list(dict.fromkeys(stated + [str(row["dataset"]) for row in results["rows"]]))


def raw_row(rows: Iterable[Row], dataset: str) -> Row | None:
    """Return the raw reference of a data set, by the exact sweep unless only the grid was run.

    The rows of subspaces are swept exactly too, so that the two differ in the lifting only.
    """
    by_search = {
        str(row.get("threshold_search")): row
        for row in sorted(rows, key=lambda row: str(row["metric"]), reverse=True)
        if row["dataset"] == dataset and row["strategy"] == "raw"
    }
    return by_search.get("exact") or by_search.get("grid")


def preferred_metric(rows: Iterable[Row]) -> str | None:
    """Return the metric to show where only one can be: spherical, as the product decides."""
    present = {str(row["metric"]) for row in rows}
    return next((metric for metric in PREFERRED_METRICS if metric in present), None)


def fmr_targets(rows: Iterable[Row]) -> list[str]:
    """Return the FMR targets that any row has, the largest first, as they are spelled there."""
    spelled = {target for row in rows for target in row.get("fnmr_at_fmr") or {}}
    return sorted(spelled, key=float, reverse=True)
