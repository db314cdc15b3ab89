"""From runs to rows: means over repeats and lifted sides, with intervals, as plain JSON."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from templates.contract import wire
from templates.decoys import DecoyPool
from templates.space.lifting import Strategy
from verify.evaluation.material import Source
from verify.evaluation.resampling import Interval, fmr_grid
from verify.evaluation.runs import Run
from verify.evaluation.units import Cell, Mode, Search
from verify.metrics import resolvable, wilson

Json = dict[str, Any]


@dataclass(frozen=True)
class SetFacts:
    """What rows repeat of their set.

    Parameters
    ----------
    failed_genuine, failed_impostor
        Pairs with a photo that gave no descriptor.
    fta
        Share of photos that gave none (ISO/IEC 19795-1).
    names_people
        Whether people can be resampled.
    """

    name: str
    genuine: int
    impostor: int
    failed_genuine: int
    failed_impostor: int
    fta: float
    names_people: bool

    @property
    def interval(self) -> Interval:
        """What the intervals of curves resample."""
        return "subject-bootstrap" if self.names_people else "pair-bootstrap"


def grouped(runs: Sequence[Run]) -> dict[tuple[Cell, Search], list[Run]]:
    """Runs by row, in the order of their seeds and sides whatever order they came in."""
    rows: defaultdict[tuple[Cell, Search], list[Run]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: (run.seed or 0, run.lifted or "")):
        rows[run.cell, run.search].append(run)
    return dict(rows)


def cell_json(cell: Cell) -> Json:
    """Name a cell, as rows, runs, curves and timings do."""
    return {**asdict(cell), "mode": cell.mode.value}


def row_json(
    cell: Cell,
    search: Search,
    runs: Sequence[Run],
    facts: SetFacts,
    *,
    seed: int,
    n: int,
    source: Source | None,
    contract_id: str | None,
) -> Json:
    """Summarise the runs of one row.

    ``accuracy_std`` is the spread over folds inside a run, ``accuracy_std_seeds`` that of the
    mean accuracy over seeds, None where there are not two. Of the two sides of point-to-subspace
    comparisons every figure is the mean.
    """
    accuracies = np.array([run.measures.ten_fold.accuracies for run in runs])
    thresholds = np.array([run.measures.ten_fold.thresholds for run in runs])
    by_seed: defaultdict[int | None, list[float]] = defaultdict(list)
    for run, accuracy in zip(runs, accuracies.mean(axis=1).tolist(), strict=True):
        by_seed[run.seed].append(accuracy)
    seeds = [float(np.mean(values)) for values in by_seed.values()]
    spaces = cell.mode is Mode.SUBSPACE
    return {
        "dataset": facts.name,
        **cell_json(cell),
        "threshold_search": search,
        "accuracy_mean": float(accuracies.mean()),
        "accuracy_std": float(accuracies.std(axis=1).mean()),
        "accuracy_std_seeds": float(np.std(seeds, ddof=1)) if len(seeds) > 1 else None,
        "eer": _mean(run.measures.eer for run in runs),
        "auc": _mean(run.measures.auc for run in runs),
        "d_prime": _finite(_mean(run.measures.d_prime for run in runs)),
        "fnmr_at_fmr": {
            target_name(errors.target): _at(runs, place, facts)
            for place, errors in enumerate(runs[0].measures.at)
        },
        "threshold_mean": float(thresholds.mean()),
        "thresholds": thresholds.mean(axis=0).tolist(),
        "n_genuine": facts.genuine,
        "n_impostor": facts.impostor,
        "failed_genuine": facts.failed_genuine,
        "failed_impostor": facts.failed_impostor,
        "runs": len(runs),
        "collision_floor": collision_floor(cell, source) if spaces else None,
        "collisions_mean": _mean(run.measures.collisions for run in runs) if spaces else None,
        "template_bytes": template_bytes(cell, n),
        "contract_id": contract_id,
        "seed": seed,
    }


def target_name(target: float) -> str:
    """Name a target as a key of JSON: ``0.01``."""
    return f"{target:g}"


def _mean(values: Any) -> float:
    return float(np.mean(list(values)))


def _finite(value: float) -> float | None:
    """JSON has no infinity: two classes without any spread are infinitely far apart."""
    return value if np.isfinite(value) else None


def _at(runs: Sequence[Run], place: int, facts: SetFacts) -> Json:
    errors_at = [run.measures.at[place] for run in runs]
    errors, fmr_errors = _mean(e.errors for e in errors_at), _mean(e.fmr_errors for e in errors_at)
    value, fmr = errors / facts.genuine, fmr_errors / facts.impostor
    low, high = wilson(errors, facts.genuine)
    # With few errors, resampling what was seen knows nothing of what was not: hence both.
    lower, upper = _percentiles(np.stack([run.replicates[:, place] for run in runs])[..., None])
    low, high = min(low, float(lower[0])), max(high, float(upper[0]))
    return {
        "value": value,
        "ci_low": low,
        "ci_high": high,
        "interval": facts.interval,
        "trials": facts.genuine,
        "errors_mean": errors,
        "threshold_mean": _mean(e.threshold for e in errors_at),
        "fmr": fmr,
        "fmr_errors_mean": fmr_errors,
        "far": fmr * (1 - facts.fta),
        "frr": facts.fta + value * (1 - facts.fta),
    }


def _percentiles(
    replicates: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """95 % interval of the mean over runs; (runs, R, F) to two (F,).

    In each replicate the runs are drawn with replacement too, so that the interval holds what
    comes from the choice of decoys as well as what comes from the choice of people.
    """
    runs, count, _ = replicates.shape
    drawn = np.random.default_rng(runs).integers(runs, size=(runs, count))
    means = replicates[drawn, np.arange(count)].mean(axis=0, dtype=np.float64)
    low, high = np.percentile(means, [2.5, 97.5], axis=0)
    return low, high


def curve_json(cell: Cell, runs: Sequence[Run], facts: SetFacts) -> Json:
    """FNMR over FMR of one row, with a 95 % band."""
    first = len(runs[0].measures.at)
    low, high = _percentiles(np.stack([run.replicates[:, first:] for run in runs]))
    return {
        "dataset": facts.name,
        **cell_json(cell),
        "fmr": fmr_grid(facts.impostor).tolist(),
        "fnmr": np.mean([run.curve for run in runs], axis=0).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "interval": facts.interval,
    }


def run_json(run: Run, dataset: str) -> Json:
    """All figures of one run with their raw counts."""
    measures = run.measures
    return {
        "dataset": dataset,
        **cell_json(run.cell),
        "threshold_search": run.search,
        "seed": run.seed,
        "lifted": run.lifted,
        "accuracies": list(measures.ten_fold.accuracies),
        "thresholds": list(measures.ten_fold.thresholds),
        "eer": measures.eer,
        "auc": measures.auc,
        "d_prime": _finite(measures.d_prime),
        "collisions": measures.collisions if run.cell.mode is Mode.SUBSPACE else None,
        "fnmr_at_fmr": {
            target_name(errors.target): {
                key: value for key, value in asdict(errors).items() if key != "target"
            }
            for errors in measures.at
        },
    }


def template_bytes(cell: Cell, n: int) -> int:
    """Bytes that a stored template has: on the wire, in float16; raw descriptors as float32."""
    if cell.mode is Mode.RAW:
        return 4 * n
    return wire.encoded_size(n, cell.dim, "float16")


def collision_floor(cell: Cell, source: Source | None) -> float | None:
    """Probability that two independent lifts share a decoy (docs/method.md §4.4).

    They then meet, whoever they are of: a floor of the false match rate in subspace-to-subspace
    comparisons. 0 for disjoint and for generated decoys. None for hybrid+, whose draws depend on
    the people.
    """
    strategy = Strategy(cell.strategy)
    if not isinstance(source, DecoyPool) or not cell.shared_decoys:
        return 0.0
    if strategy is Strategy.HYBRID_PLUS:
        return None
    k, parts = strategy.decoys(cell.dim), strategy.sub_databases or 1
    size = len(source) // parts
    if k == 0 or size == 0:
        return 0.0
    return (1 - comb(size - k, k) / comb(size, k)) / parts


def refused_targets(targets: Sequence[float], facts: Mapping[str, int]) -> list[str]:
    """Say which FMR targets the impostor pairs of which sets cannot resolve, and why."""
    sentences = []
    for name, impostor in facts.items():
        unresolved = [target for target in targets if not resolvable(target, impostor)]
        if unresolved:
            listed = ", ".join(target_name(target) for target in unresolved)
            sentences.append(
                f"{name}: FMR {listed} is not reported. With no error in {impostor} impostor "
                f"pairs the 95 % upper bound is still 3/{impostor} = {3 / max(1, impostor):.2g}; "
                "give a set with more of them"
            )
    return sentences
