"""A row of the attribute report: how well one attacker infers one attribute from one scheme.

Accuracy below chance is leakage: an attacker who knows the rule turns it round (docs/method.md
§4.5). But chance has several values. An attacker who deals out labels at random, a share q_c of
class c, is right in Σ q_c p_c of the cases, which is below the majority's share whenever the
classes differ in size. So what leaks is how far exactly these predictions are from the same ones
dealt out at random.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import KnowledgeLevel, Scheme
from templates.contract.canonical import Json
from templates.contract.levels import Rate
from verify.metrics import rate

Codes = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class AttributeRow:
    """Predictions of one attacker against the truth.

    Parameters
    ----------
    attacker
        ``knn`` (the paper's), ``logistic`` (a regression on faces that the attacker lifted),
        ``second moments`` (the same with the point that is likeliest to be the embedding, given
        what the generator's decoys do), ``strip`` (with what is left without the known decoys).
    metric
        That neighbours were searched by; None where both or none were.
    knowledge
        What the attacker has: ``algorithm`` (and other, labelled faces), or ``decoys`` too.
    classes
        Names in the order of the confusion's rows and columns.
    accuracy
        Its ``errors`` are the faces whose class is right: what a defender counts as an error.
    balanced_accuracy
        Mean over the classes that occur of the share that is right.
    confusion
        Counts; a row for each true class, a column for each predicted one.
    baselines
        Accuracies of attackers who see no template: ``uniform`` draws a class, 1/C, the paper's
        line; ``majority`` is the share of the largest class of the attacked faces;
        ``same_predictions`` are these very predictions dealt out at random, Σ q p.
    held_out
        The attacker's :attr:`strength` on faces that it lifted itself and did not learn from, of
        ``knn`` on all that it lifted: what it chooses the best attacker by, before it sees a
        victim.
    """

    scheme: Scheme
    attribute: str
    attacker: str
    metric: str | None
    knowledge: KnowledgeLevel
    classes: tuple[str, ...]
    accuracy: Rate
    balanced_accuracy: float
    confusion: tuple[tuple[int, ...], ...]
    baselines: Mapping[str, float]
    seed: int
    held_out: float = 0.0

    @property
    def chance(self) -> float:
        """Share of the largest class of the attacked faces."""
        return self.baselines["majority"]

    @property
    def chance_of_predictions(self) -> float:
        """Share that is right of the same predictions dealt out at random: what leaks is beyond."""
        return self.baselines["same_predictions"]

    @property
    def strength(self) -> float:
        """How far the accuracy is from that of the same predictions dealt out at random.

        Not from the majority's share, beneath which an attacker who knows nothing scores too.
        """
        return abs(self.accuracy.value - self.chance_of_predictions)

    def to_json(self) -> dict[str, Json]:
        """Return a row of ``rows`` of the report."""
        return {
            **self.scheme.to_json(),
            "attribute": self.attribute,
            "attacker": self.attacker,
            "metric": self.metric,
            "knowledge": str(self.knowledge),
            "seed": self.seed,
            "accuracy": self.accuracy.value,
            "chance": self.chance,
            "chance_of_predictions": self.chance_of_predictions,
            "correct": self.accuracy.errors,
            "trials": self.accuracy.trials,
            "ci_low": self.accuracy.ci_low,
            "ci_high": self.accuracy.ci_high,
            "balanced_accuracy": self.balanced_accuracy,
            "classes": list(self.classes),
            "confusion": [list(row) for row in self.confusion],
            "baselines": dict(self.baselines),
            "held_out_strength": self.held_out,
        }


def measure(
    predicted: Codes, truth: Codes, *, classes: tuple[str, ...], **names: Any
) -> AttributeRow:
    """Compare predictions with the truth; both are class numbers, (N,) int64.

    ``names`` are the fields of the row that say what was attacked, and by whom.
    """
    size, count = len(classes), len(truth)
    table = np.bincount(truth * size + predicted, minlength=size**2).reshape(size, size)
    of_truth, of_predicted = table.sum(axis=1), table.sum(axis=0)
    occurring = of_truth > 0
    return AttributeRow(
        classes=classes,
        accuracy=rate(int(np.trace(table)), count),
        balanced_accuracy=float(np.mean(np.diag(table)[occurring] / of_truth[occurring])),
        confusion=tuple(tuple(map(int, row)) for row in table),
        baselines={
            "uniform": 1 / size,
            "majority": float(of_truth.max()) / count,
            "same_predictions": float(of_truth @ of_predicted) / count**2,
        },
        **names,
    )


def strongest(
    rows: Iterable[AttributeRow],
) -> dict[tuple[Scheme, str, KnowledgeLevel], AttributeRow]:
    """Return the attacker to quote for each scheme, attribute and knowledge.

    It is the one that was strongest, above or below chance, on the attacker's own held-out faces.
    The best on the attacked faces themselves would be quoted with the luck of the best of several.
    """
    best: dict[tuple[Scheme, str, KnowledgeLevel], AttributeRow] = {}
    for row in rows:
        key = (row.scheme, row.attribute, row.knowledge)
        if key not in best or row.held_out > best[key].held_out:
            best[key] = row
    return best
