"""The results of an evaluation: rows that are means of runs, and where every figure came from."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import pandas as pd

from verify.evaluation.comparison import Trials
from verify.evaluation.experiment import (
    ARRAYS,
    CELL,
    ROW,
    SetResult,
    group_rates,
)
from verify.evaluation.intervals import fmr_grid, percentiles
from verify.evaluation.labels_file import Labels
from verify.evaluation.plan import EvaluationPlan, Json
from verify.evaluation.provenance import software
from verify.evaluation.sources import SourceFacts
from verify.metrics import resolvable, wilson
from verify.tenfold import FOLDS

FORMAT = "veilface evaluation"
VERSION = 1


def document(
    plan: EvaluationPlan,
    model: Json,
    sources: Sequence[SourceFacts],
    runs: pd.DataFrame,
    results: Sequence[SetResult],
    labels: Labels | None,
    *,
    options: Json,
) -> Json:
    """Put everything together, as plain JSON that depends on seeds and inputs only."""
    trials = {result.trials.name: result.trials for result in results}
    rows, curves = [], []
    for names, lines in runs.groupby(ROW, sort=False, dropna=False):
        rows.append(row_of(lines, trials[names[0]], plan))
        if rows[-1]["threshold_search"] == "exact":
            curves.append(curve_of(lines, trials[names[0]]))
    groups, summaries = ([], []) if labels is None else group_rates(runs, results, labels, plan)
    return {
        "format": FORMAT,
        "version": VERSION,
        "software": software(),
        "seed": plan.seed,
        "repeats": plan.repeats,
        "options": {
            **asdict(plan),
            **options,
            "predicted_attributes": {
                result.trials.name: result.predicted
                for result in results
                if result.predicted is not None
            },
        },
        "model": model,
        "decoys": [
            {**source.json(), "file": source.file, "sha256": source.sha256} for source in sources
        ],
        "datasets": [_dataset(result) for result in results],
        "rows": rows,
        "groups": groups,
        "group_summaries": summaries,
        "refused": refused_targets(plan.targets, {n: one.impostor for n, one in trials.items()}),
        "runs": runs.drop(columns=ARRAYS).to_dict("records"),
        "curves": curves,
        "folds": FOLDS,
    }


def _dataset(result: SetResult) -> Json:
    """Counts, hashes and failures to acquire."""
    faces, pairs, trials = result.faces, result.faces.pairs, result.trials
    return {
        "name": pairs.name,
        "kind": pairs.kind,
        "images": len(pairs.pictures),
        "templates": None if pairs.templates is None else len(pairs.templates),
        "pairs": len(pairs),
        "genuine": pairs.genuine,
        "impostor": pairs.impostor,
        "people": None if pairs.people is None else len(set(pairs.people)),
        "aligned": faces.aligned,
        "protocol_files": [list(entry) for entry in pairs.protocol_files],
        "failures": [
            {"image": failure.path.as_posix(), "code": failure.code, "reason": failure.reason}
            for failure in faces.failures
        ],
        "failed_genuine": trials.failed_genuine,
        "failed_impostor": trials.failed_impostor,
        "fta": trials.fta,
        "decoys": [{**source.json(), "left_out": source.left_out} for source in result.sources],
    }


def row_of(lines: pd.DataFrame, trials: Trials, plan: EvaluationPlan) -> Json:
    """Summarise the runs of one row.

    ``accuracy_std`` is the spread over folds inside a run, ``accuracy_std_seeds`` that of the
    mean accuracy over seeds, None where there are not two. Of the two sides of point-to-subspace
    comparisons every figure is the mean.
    """
    return {
        **lines.iloc[0][ROW].to_dict(),
        **_accuracy(lines),
        "eer": float(lines["eer"].mean()),
        "auc": float(lines["auc"].mean()),
        "fnmr_at_fmr": {
            target: _at(lines, place, target, trials)
            for place, target in enumerate(lines["fnmr_at_fmr"].iloc[0])
        },
        "n_genuine": trials.genuine,
        "n_impostor": trials.impostor,
        "failed_genuine": trials.failed_genuine,
        "failed_impostor": trials.failed_impostor,
        "runs": len(lines),
        "seed": plan.seed,
    }


def _accuracy(lines: pd.DataFrame) -> Json:
    if lines["accuracies"].iloc[0] is None:
        names = ("accuracy_mean", "accuracy_std", "accuracy_std_seeds", "threshold_mean")
        return dict.fromkeys(names)
    accuracies, thresholds = (np.stack(lines[name]) for name in ("accuracies", "thresholds"))
    seeds = lines.assign(mean=accuracies.mean(axis=1)).groupby("seed", dropna=False)["mean"].mean()
    return {
        "accuracy_mean": float(accuracies.mean()),
        "accuracy_std": float(accuracies.std(axis=1).mean()),
        "accuracy_std_seeds": float(seeds.std()) if len(seeds) > 1 else None,
        "threshold_mean": float(thresholds.mean()),
    }


def _at(lines: pd.DataFrame, place: int, target: str, trials: Trials) -> Json:
    means = pd.DataFrame([at[target] for at in lines["fnmr_at_fmr"]]).mean()
    low, high = wilson(means["errors"], trials.genuine)
    # With few errors, resampling what was seen knows nothing of what was not: hence both.
    lower, upper = percentiles(np.stack(lines["replicates"])[:, :, place, None])
    return {
        "value": float(means["errors"] / trials.genuine),
        "ci_low": min(low, float(lower[0])),
        "ci_high": max(high, float(upper[0])),
        "interval": _interval(trials),
        "trials": trials.genuine,
        "errors_mean": float(means["errors"]),
        "threshold_mean": float(means["threshold"]),
        "fmr": float(means["fmr_errors"] / trials.impostor),
        "fmr_errors_mean": float(means["fmr_errors"]),
    }


def _interval(trials: Trials) -> str:
    """Say what the intervals resample."""
    return "pair-bootstrap" if trials.people is None else "subject-bootstrap"


def curve_of(lines: pd.DataFrame, trials: Trials) -> Json:
    """FNMR over FMR of one row, with a 95 % band."""
    grid = fmr_grid(trials.impostor)
    low, high = percentiles(np.stack(lines["replicates"])[:, :, -len(grid) :])
    return {
        **lines.iloc[0][CELL].to_dict(),
        "fmr": grid.tolist(),
        "fnmr": np.mean(np.stack(lines["curve"]), axis=0).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "interval": _interval(trials),
    }


def refused_targets(targets: Sequence[float], impostors: dict[str, int]) -> list[str]:
    """Say which FMR targets the impostor pairs of which sets cannot resolve, and why."""
    sentences = []
    for name, impostor in impostors.items():
        unresolved = [target for target in targets if not resolvable(target, impostor)]
        if unresolved:
            listed = ", ".join(f"{target:g}" for target in unresolved)
            sentences.append(
                f"{name}: FMR {listed} is not reported. With no error in {impostor} impostor "
                f"pairs the 95 % upper bound is still 3/{impostor} = {3 / max(1, impostor):.2g}; "
                "give a set with more of them"
            )
    return sentences
