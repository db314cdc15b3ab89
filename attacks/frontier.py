"""Accuracy against privacy: every scheme's verification accuracy beside what leaks from it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from attacks.errors import AuditError
from attacks.outcomes import GENERATED, Knowledge, Scheme
from templates.contract.canonical import Json
from verify.evaluation.row_labels import datasets_of, preferred_metric, raw_row

Row = Mapping[str, Any]
MODE = "p2s"


@dataclass(frozen=True)
class Accuracies:
    """Ten-fold accuracies of an evaluation, fractions.

    Parameters
    ----------
    dataset, metric
        Of which set, by which metric, point to subspace.
    """

    dataset: str
    metric: str
    raw: float
    of: Mapping[Scheme, float]


@dataclass(frozen=True)
class Point:
    """One scheme on the frontier.

    Parameters
    ----------
    accuracy
        Mean ten-fold accuracy of verification, a fraction.
    leaks
        By attribute, the row of the strongest attacker who knows the algorithm but neither decoys
        nor keys.
    """

    scheme: Scheme
    accuracy: float
    leaks: Mapping[str, Row]

    @property
    def leakage(self) -> float:
        """Largest distance of any attribute's accuracy from chance."""
        return max(_far(row) for row in self.leaks.values())


def verification_accuracy(results: Row, schemes: Iterable[Scheme]) -> Accuracies:
    """Find the accuracies that an evaluation has of some schemes, before anything is attacked.

    Raises
    ------
    AuditError
        It has none of them, or no row of raw descriptors, or lacks fields.
    """
    try:
        name = datasets_of(results)[0]
        raw = raw_row(results["rows"], name)
        rows = [
            row
            for row in results["rows"]
            if row["dataset"] == name
            and row["mode"] == MODE
            and row.get("accuracy_mean") is not None
        ]
        metric = preferred_metric(rows)
        accuracies = {
            Scheme.of(row): float(row["accuracy_mean"]) for row in rows if row["metric"] == metric
        }
        raw_accuracy = None if raw is None else float(raw["accuracy_mean"])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise AuditError(
            f"the results of the evaluation lack what is needed ({type(error).__name__}): give the "
            "results.json of `veilface evaluate`"
        ) from None
    common = {scheme: accuracies[scheme] for scheme in schemes if scheme in accuracies}
    if not common or raw_accuracy is None:
        raise AuditError(
            "the evaluation and the audit have no scheme in common, or the evaluation has no raw "
            "row: run `veilface evaluate` with raw and with the strategies and dimensions of the "
            "audit, p2s"
        )
    return Accuracies(name, str(metric), raw_accuracy, common)


def frontier(results: Row, rows: Sequence[Row], *, most_lost: float) -> dict[str, Json]:
    """Join an evaluation with attribute inference, and recommend an operating point.

    Of the schemes with generated decoys (a pool is open to whoever has it, and its people are
    accepted) that lose at most ``most_lost`` of the raw accuracy, the one is recommended from
    which the strongest attacker learns least; of those within the interval of that one, the most
    accurate. Point to subspace, in the metric that the product decides with where it was run.

    Parameters
    ----------
    rows
        Of attribute inference; of several attackers the one that was strongest on the attacker's
        own held-out faces counts.

    Raises
    ------
    AuditError
        No scheme is in both.
    """
    leaks = _strongest(rows)
    accuracies = verification_accuracy(results, leaks)
    points = [Point(scheme, value, leaks[scheme]) for scheme, value in accuracies.of.items()]
    least = accuracies.raw - most_lost
    able = [
        point for point in points if point.accuracy >= least and point.scheme.decoys == GENERATED
    ]
    chosen = _recommended(able)
    said = f"{accuracies.dataset}: raw embeddings reach {100 * accuracies.raw:.2f} %. " + (
        f"Recommended: {chosen.scheme}, the least leakage among those that lose at most "
        f"{100 * most_lost:g} points, or as little within its interval and more accurate."
        if chosen
        else f"No scheme loses at most {100 * most_lost:g} points."
    )
    said += (
        " Only attribute inference is weighed here: veilface audit templates says what else is "
        "learnt from a template."
    )
    return {
        "dataset": accuracies.dataset,
        "mode": MODE,
        "metric": accuracies.metric,
        "raw_accuracy": accuracies.raw,
        "most_lost": most_lost,
        "statement": said,
        "points": [
            {
                **point.scheme.to_json(),
                "accuracy": point.accuracy,
                "leakage": point.leakage,
                "recommended": point is chosen,
                "leaks": {
                    attribute: {
                        "attacker": row["attacker"],
                        "accuracy": row["accuracy"],
                        "chance": row["chance"],
                    }
                    for attribute, row in point.leaks.items()
                },
            }
            for point in sorted(points, key=lambda point: point.scheme.order)
        ],
    }


def _strongest(rows: Sequence[Row]) -> dict[Scheme, dict[str, Row]]:
    strongest: dict[Scheme, dict[str, Row]] = {}
    for row in rows:
        if row["knowledge"] not in (Knowledge.TEMPLATE, Knowledge.ALGORITHM):
            continue
        scheme = Scheme.of(row)
        best = strongest.setdefault(scheme, {})
        now = best.get(row["attribute"])
        if now is None or row["held_out_strength"] > now["held_out_strength"]:
            best[row["attribute"]] = row
    return strongest


def _far(row: Row) -> float:
    """Distance from what the same predictions would score if they were dealt out at random."""
    return abs(float(row["accuracy"]) - float(row["chance_of_predictions"]))


def _recommended(points: Sequence[Point]) -> Point | None:
    if not points:
        return None
    best = min(points, key=lambda point: point.leakage)
    row = max(best.leaks.values(), key=_far)
    within = best.leakage + (float(row["ci_high"]) - float(row["ci_low"])) / 2
    return max(
        (point for point in points if point.leakage <= within), key=lambda point: point.accuracy
    )
