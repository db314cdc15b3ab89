"""The results of an evaluation: rows that are means of runs, and where every figure came from."""

from collections.abc import Sequence
from dataclasses import asdict
from math import comb

import numpy as np
import pandas as pd

from templates.contract import wire
from templates.contract.binding import Binding
from templates.decoys import DecoyPool
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
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
from verify.evaluation.plan import EvaluationPlan, Json, Mode, Source, decoy_kind
from verify.evaluation.provenance import Model, software
from verify.evaluation.readers import notes
from verify.evaluation.sources import SourceFacts, resemblance
from verify.metrics import resolvable, wilson
from verify.tenfold import FOLDS

FORMAT = "veilface evaluation"
VERSION = 1


def document(
    plan: EvaluationPlan,
    model: Model,
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
        rows.append(row_of(lines, trials[names[0]], plan, model))
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
            "resemblance": {
                name: resemblance(one)
                for name, one in trials.items()
                if any(isinstance(source, DecoyPool) for source in one.sources)
            },
        },
        "model": model.json(),
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
        "pictures_sha256": faces.pictures_sha256,
        "protocol_files": [list(entry) for entry in pairs.protocol_files],
        "failures": [
            {"image": failure.path.as_posix(), "code": failure.code, "reason": failure.reason}
            for failure in faces.failures
        ],
        "failed_genuine": trials.failed_genuine,
        "failed_impostor": trials.failed_impostor,
        "fta": trials.fta,
        "decoys": [{**source.json(), "left_out": source.left_out} for source in result.sources],
        "notes": notes(pairs),
    }


def row_of(lines: pd.DataFrame, trials: Trials, plan: EvaluationPlan, model: Model) -> Json:
    """Summarise the runs of one row.

    ``accuracy_std`` is the spread over folds inside a run, ``accuracy_std_seeds`` that of the
    mean accuracy over seeds, None where there are not two. Of the two sides of point-to-subspace
    comparisons every figure is the mean.
    """
    names = lines.iloc[0][ROW].to_dict()
    kind, spaces = names["decoys"], names["mode"] == Mode.SUBSPACE
    source = next((source for source in trials.sources if decoy_kind(source) == kind), None)
    return {
        **names,
        **_accuracy(lines),
        "eer": float(lines["eer"].mean()),
        "auc": float(lines["auc"].mean()),
        "d_prime": None if lines["d_prime"].isna().any() else float(lines["d_prime"].mean()),
        "fnmr_at_fmr": {
            target: _at(lines, place, target, trials)
            for place, target in enumerate(lines["fnmr_at_fmr"].iloc[0])
        },
        "n_genuine": trials.genuine,
        "n_impostor": trials.impostor,
        "failed_genuine": trials.failed_genuine,
        "failed_impostor": trials.failed_impostor,
        "runs": len(lines),
        "collision_floor": collision_floor(names, source) if spaces else None,
        "collisions_mean": float(lines["collisions"].mean()) if spaces else None,
        "template_bytes": template_bytes(names, model.n if source is None else source.k),
        "contract_id": contract_id(model, names, source),
        "seed": plan.seed,
    }


def _accuracy(lines: pd.DataFrame) -> Json:
    if lines["accuracies"].iloc[0] is None:
        names = ("accuracy_mean", "accuracy_std", "accuracy_std_seeds", "threshold_mean")
        return {**dict.fromkeys(names), "thresholds": None}
    accuracies, thresholds = (np.stack(lines[name]) for name in ("accuracies", "thresholds"))
    seeds = lines.assign(mean=accuracies.mean(axis=1)).groupby("seed", dropna=False)["mean"].mean()
    return {
        "accuracy_mean": float(accuracies.mean()),
        "accuracy_std": float(accuracies.std(axis=1).mean()),
        "accuracy_std_seeds": float(seeds.std()) if len(seeds) > 1 else None,
        "threshold_mean": float(thresholds.mean()),
        "thresholds": thresholds.mean(axis=0).tolist(),
    }


def _at(lines: pd.DataFrame, place: int, target: str, trials: Trials) -> Json:
    means = pd.DataFrame([at[target] for at in lines["fnmr_at_fmr"]]).mean()
    value, fmr = means["errors"] / trials.genuine, means["fmr_errors"] / trials.impostor
    low, high = wilson(means["errors"], trials.genuine)
    # With few errors, resampling what was seen knows nothing of what was not: hence both.
    lower, upper = percentiles(np.stack(lines["replicates"])[:, :, place, None])
    return {
        "value": float(value),
        "ci_low": min(low, float(lower[0])),
        "ci_high": max(high, float(upper[0])),
        "interval": _interval(trials),
        "trials": trials.genuine,
        "errors_mean": float(means["errors"]),
        "threshold_mean": float(means["threshold"]),
        "fmr": float(fmr),
        "fmr_errors_mean": float(means["fmr_errors"]),
        "far": float(fmr * (1 - trials.fta)),
        "frr": float(trials.fta + value * (1 - trials.fta)),
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


def template_bytes(names: Json, n: int) -> int:
    """Bytes that a stored template has: on the wire, in float16; raw embeddings as float32."""
    if names["mode"] == Mode.RAW:
        return 4 * n
    return wire.encoded_size(n, names["dim"], "float16")


def collision_floor(names: Json, source: Source | None) -> float | None:
    """Probability that two independent lifts share a decoy (docs/method.md §4.4).

    They then meet, whoever they are of: a floor of the false match rate in subspace-to-subspace
    comparisons. 0 for disjoint and for generated decoys. None for hybrid+, whose draws depend on
    the people.
    """
    strategy = Strategy(names["strategy"])
    if not isinstance(source, DecoyPool) or not names["shared_decoys"]:
        return 0.0
    if strategy is Strategy.HYBRID_PLUS:
        return None
    k, parts = strategy.decoys(names["dim"]), strategy.sub_databases or 1
    size = len(source) // parts
    if k == 0 or size == 0:
        return 0.0
    return (1 - comb(size - k, k) / comb(size, k)) / parts


def contract_id(model: Model, names: Json, source: Source | None) -> str | None:
    """Contract that templates of a row belong to; None where none can be made.

    A contract binds an embedder and a decoy source, so raw embeddings, random lifting and
    embeddings from a file have none.
    """
    if source is None or model.embedder_sha256 is None or model.preprocessing is None:
        return None
    return Binding(
        embedder_sha256=model.embedder_sha256,
        preprocessing=model.preprocessing,
        n=model.n,
        axes=source.k,
        strategy=Strategy(names["strategy"]),
        m=names["dim"],
        decoy_source_id=source.source_id,
        rotation_version=ROTATION_VERSION,
    ).contract_id


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
