"""A row of the attribute report: how well one attacker infers one attribute from one scheme.

Accuracy below chance is leakage: an attacker who knows the rule turns it round (docs/method.md
§4.5). But chance has several values. An attacker who deals out labels at random, a share q_c of
class c, is right in Σ q_c p_c of the cases, which is below the majority's share whenever the
classes differ in size. So whether predictions leak is decided on exactly these predictions: are
they right more often, or less often, than the same ones dealt out at random?
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.outcomes import KnowledgeLevel, Scheme
from templates.contract.canonical import Json
from templates.contract.levels import Rate
from verify.metrics import rate

Codes = NDArray[np.int64]

SIGNIFICANCE = 0.01
"""Of the two-sided test. An audit has some hundreds of rows, so that a few of those that leak
nothing are called leaking; at the usual 0.05 there would be tens."""


class Leakage(StrEnum):
    """Outcome of the two-sided test."""

    ABOVE = "leaks above"
    """Right more often than the same predictions dealt out at random."""
    BELOW = "leaks below"
    """Right less often: the attacker who knows the rule turns it round."""
    NONE = "none"
    """No difference is seen. It is not shown that there is none."""


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
        line; ``majority_of_training`` says the largest class of the attacker's own faces;
        ``majority`` is the share of the largest class of the attacked faces; ``prior`` draws by
        their shares, Σ p²; ``same_predictions`` are these very predictions dealt out at random,
        Σ q p.
    p_value
        Two-sided, of the accuracy among permutations of the predictions.
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
    p_value: float
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

    @property
    def leakage(self) -> Leakage:
        """Whether the accuracy differs from chance, and to which side."""
        if self.p_value < SIGNIFICANCE:
            above = self.accuracy.value > self.chance_of_predictions
            return Leakage.ABOVE if above else Leakage.BELOW
        return Leakage.NONE

    def chosen_by(self, at_home: "AttributeRow") -> "AttributeRow":
        """Return the row with what the attacker reached on its own faces."""
        return replace(self, held_out=at_home.strength)

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
            "p_value": self.p_value,
            "leakage": str(self.leakage),
            "held_out_strength": self.held_out,
        }


def measure(
    predicted: Codes,
    truth: Codes,
    *,
    scheme: Scheme,
    attribute: str,
    attacker: str,
    metric: str | None,
    knowledge: KnowledgeLevel,
    classes: tuple[str, ...],
    training: Codes,
    seed: int,
) -> AttributeRow:
    """Compare predictions with the truth.

    Parameters
    ----------
    predicted, truth : (N,) int64
        Class numbers.
    training : (T,) int64
        Class numbers of the attacker's own faces.

    Raises
    ------
    AuditError
        There are no predictions, or not as many as truths.
    """
    if not len(truth) or len(predicted) != len(truth) or not len(training):
        raise AuditError(f"{len(predicted)} predictions do not fit {len(truth)} attacked faces")
    size, count = len(classes), len(truth)
    table = np.bincount(truth * size + predicted, minlength=size**2).reshape(size, size)
    of_truth, of_predicted = table.sum(axis=1), table.sum(axis=0)
    hits, shares = int(np.trace(table)), of_truth / count
    occurring = of_truth > 0
    return AttributeRow(
        scheme=scheme,
        attribute=attribute,
        attacker=attacker,
        metric=metric,
        knowledge=knowledge,
        classes=classes,
        accuracy=rate(hits, count),
        balanced_accuracy=float(np.mean(np.diag(table)[occurring] / of_truth[occurring])),
        confusion=tuple(tuple(map(int, row)) for row in table),
        baselines={
            "uniform": 1 / size,
            "majority_of_training": float(
                shares[int(np.argmax(np.bincount(training, minlength=size)))]
            ),
            "majority": float(shares.max()),
            "prior": float(shares @ shares),
            "same_predictions": float(shares @ of_predicted) / count,
        },
        p_value=_two_sided(hits, of_truth, of_predicted),
        seed=seed,
    )


def _two_sided(hits: int, of_truth: Codes, of_predicted: Codes) -> float:
    """P-value of a number of hits among permutations of the predictions.

    Notes
    -----
    The number of hits has a mean and a variance in closed form [1]_; for the sizes of an audit its
    distribution is normal.

    References
    ----------
    .. [1] W. Hoeffding, "A combinatorial central limit theorem", Ann. Math. Statist. 22 (1951).
    """
    count = int(of_truth.sum())
    rows, columns = of_predicted / count, of_truth / count
    mean = float(of_truth @ of_predicted) / count
    centred = np.eye(len(rows)) - rows[:, None] - columns[None, :] + mean / count
    variance = float(of_truth @ centred**2 @ of_predicted) / max(1, count - 1)
    if variance <= 1e-12:  # one class only, of the truth or of the predictions
        return 1.0
    # The count is whole: half a hit less, or the test would be too lax on few faces.
    distance = max(0.0, abs(hits - mean) - 0.5)
    return math.erfc(distance / math.sqrt(2 * variance))


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
