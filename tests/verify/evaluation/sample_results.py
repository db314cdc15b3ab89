"""A results document that nobody measured, of the shape and size of a real one."""

from collections.abc import Sequence
from typing import Any

import numpy as np

DIFFICULTY = {"lfw": 0.994, "cfp_ff": 0.992, "cfp_fp": 0.975, "agedb_30": 0.965}
STRENGTH = {"random": 0.02, "hybrid": 0.5, "hybrid+": 0.55, "sub-hybrid": 0.5}
ALL_LIFTINGS = (
    ("random", None),
    ("adversarial", "pool"),
    ("adversarial", "generator"),
    ("hybrid", "pool"),
    ("hybrid+", "pool"),
)
GRID = np.geomspace(1 / 3000, 1, 25)


def sample_results(
    *,
    datasets: Sequence[str] = ("lfw",),
    liftings: Sequence[tuple[str, str | None]] = ALL_LIFTINGS,
    dims: Sequence[int] = (2, 4, 8, 16),
    modes: Sequence[str] = ("p2s", "s2s"),
    metrics: Sequence[str] = ("euclidean", "spherical"),
    shared: Sequence[bool] = (False,),
    failures: int = 2,
    seed: int = 0,
) -> dict[str, Any]:
    """Draw a document by a seeded generator; accuracies fall with m as they would."""
    rng = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for name in datasets:
        best = DIFFICULTY[name]
        for strategy, gain in (("raw", 0.0), ("raw+flip", 0.001)):
            for search in ("exact", "grid"):
                rows.append(
                    _row(rng, best + gain, name, strategy, None, 0, "p2p", "euclidean", search)
                )
        for strategy, decoys in liftings:
            for mode in modes:
                for sharing in shared if mode == "s2s" and decoys == "pool" else (None,):
                    for dim in dims:
                        for metric in metrics:
                            loss = STRENGTH.get(strategy, 1.0) * np.log2(dim + 1) / 4
                            loss *= 0.006 if mode == "p2s" else 0.3
                            loss *= 1.0 if metric == "euclidean" else 0.4
                            loss *= 1.2 if sharing else 1.0
                            row = _row(rng, best - loss, name, strategy, decoys, dim, mode, metric)
                            row["shared_decoys"] = sharing
                            if mode == "s2s":
                                row["collision_floor"] = dim**2 / 5000 if sharing else 0.0
                                row["collisions_mean"] = float(rng.integers(0, 5) * dim / 4)
                            rows.append(row)
    return {
        "format": "veilface evaluation",
        "version": 1,
        "software": {"veilface": "0.0.0", "python": "3.11.9", "numpy": "2.2.0"},
        "seed": seed,
        "repeats": 3,
        "options": {},
        "model": {"pack": "made_up", "embedder_sha256": "ab" * 32, "preprocessing": {}, "n": 512},
        "decoys": [
            {"kind": "pool", "source_id": "made up", "entries": 5000}
            | {"labelled": True, "file": "pool.veil", "sha256": "cd" * 32}
        ],
        "datasets": [_dataset(name, failures) for name in datasets],
        "rows": rows,
        "runs": [{"dataset": datasets[0], "mode": "p2s", "seed": s} for s in (0, 1, 2)],
        "groups": [],
        "group_summaries": [],
        "curves": [_curve(rng, row) for row in rows if row["threshold_search"] == "exact"],
        "refused": ["FMR 1e-4 on lfw: 3,000 impostor pairs resolve 1e-3."],
    }


def _row(
    rng: np.random.Generator,
    accuracy: float,
    dataset: str,
    strategy: str,
    decoys: str | None,
    dim: int,
    mode: str,
    metric: str,
    search: str = "exact",
) -> dict[str, Any]:
    accuracy = float(np.clip(accuracy + rng.normal(0, 0.0005), 0.5, 1.0))
    fnmr = {
        target: float(np.clip((1 - accuracy) * scale, 0, 1))
        for target, scale in (("0.01", 0.9), ("0.001", 3.0))
    }
    return {
        "dataset": dataset,
        "strategy": strategy,
        "decoys": decoys,
        "shared_decoys": None,
        "dim": dim,
        "mode": mode,
        "metric": metric,
        "threshold_search": search,
        "accuracy_mean": accuracy,
        "accuracy_std": float(rng.uniform(0.002, 0.004)) * (1 + 10 * (1 - accuracy)),
        "accuracy_std_seeds": 0.0004 if dim else None,
        "eer": 1 - accuracy,
        "auc": 1 - (1 - accuracy) ** 2,
        "d_prime": 5.1,
        "fnmr_at_fmr": {
            target: {"value": value, "ci_low": value * 0.7, "ci_high": min(1.0, value * 1.4)}
            | {"interval": "subject-bootstrap", "trials": 3000, "errors_mean": value * 3000}
            | {"threshold_mean": 0.2, "fmr": float(target), "fmr_errors_mean": 29.1}
            | {"far": float(target), "frr": value}
            for target, value in fnmr.items()
        },
        "threshold_mean": 0.21,
        "thresholds": [float(value) for value in rng.normal(0.21, 0.003, 10)],
        "n_genuine": 3000,
        "n_impostor": 3000,
        "failed_genuine": 0,
        "failed_impostor": 0,
        "runs": 6 if mode == "p2s" else 3,
        "collision_floor": None,
        "collisions_mean": None,
        "template_bytes": 2048 if not dim else 1024 * (dim + 1),
        "contract_id": None if mode == "p2p" else "ef" * 16,
        "seed": 0,
    }


def _dataset(name: str, failures: int) -> dict[str, Any]:
    return {
        "name": name,
        "kind": "lfw" if name == "lfw" else "bin",
        "images": 7701,
        "pairs": 6000,
        "genuine": 3000,
        "impostor": 3000,
        "people": 4281 if name == "lfw" else None,
        "aligned": True,
        "pictures_sha256": "12" * 32,
        "protocol_files": [["pairs.txt", "34" * 32]],
        "failures": [
            {"image": f"Nobody_{i}/Nobody_{i}_0001.jpg", "code": "no_face", "reason": "no | face"}
            for i in range(failures)
        ],
        "decoys": [{"kind": "pool", "source_id": "made up", "entries": 4997, "left_out": 3}],
        "failed_genuine": failures,
        "failed_impostor": 0,
        "fta": failures / 7701,
        "notes": [],
    }


def _curve(rng: np.random.Generator, row: dict[str, Any]) -> dict[str, Any]:
    names = ("dataset", "strategy", "decoys", "shared_decoys", "dim", "mode", "metric")
    eer = row["eer"]
    fnmr = np.clip(eer * (eer / GRID) ** 0.6, 0, 1)
    fnmr[-1] = 0.0
    return {name: row[name] for name in names} | {
        "fmr": GRID.tolist(),
        "fnmr": fnmr.tolist(),
        "low": (fnmr * 0.7).tolist(),
        "high": np.minimum(1, fnmr * 1.4).tolist(),
        "interval": "subject-bootstrap",
    }
