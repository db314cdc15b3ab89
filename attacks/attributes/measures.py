"""How much a list of predictions tells of the truth, and whether it tells more than chance.

Accuracy below chance is leakage: whoever knows the rule turns it round (docs/method.md §4.5). But
chance has several values. An attacker who deals out labels at random, a share q_c of class c, is
right in Σ q_c p_c of the cases, which is below the majority's share whenever the classes differ in
size. So whether predictions leak is asked of exactly these predictions: are they right more often,
or less often, than the same ones dealt out at random?
"""

import math
from dataclasses import asdict, dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.contract.canonical import Json
from templates.contract.levels import Rate
from verify.metrics import rate

Codes = NDArray[np.int64]

SIGNIFICANCE = 0.01
"""Of the two-sided test. An audit asks some hundreds of rows, so that a few of those that leak
nothing are called leaking; at the usual 0.05 there would be tens."""
PERMUTATIONS = 200


class Leakage(StrEnum):
    """AttackOutcome of the two-sided test."""

    ABOVE = "leaks above"
    """Right more often than the same predictions dealt out at random."""
    BELOW = "leaks below"
    """Right less often: the attacker who knows the rule turns it round."""
    NONE = "none"
    """No difference is seen. It is not shown that there is none."""


@dataclass(frozen=True)
class Baselines:
    """Accuracies of attackers who see no template.

    Parameters
    ----------
    uniform
        Of one who draws a class with equal probabilities: 1/C, the paper's line.
    majority_of_training
        Of one who always says the largest class of the attacker's own faces.
    majority
        Share of the largest class of the attacked faces: no constant guess is better.
    prior
        Of one who draws by the attacked faces' shares: Σ p².
    same_predictions
        Of these very predictions dealt out at random: Σ q p.
    """

    uniform: float
    majority_of_training: float
    majority: float
    prior: float
    same_predictions: float

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return asdict(self)


@dataclass(frozen=True)
class MutualInformation:
    """What the prediction says of the truth, in bits.

    Parameters
    ----------
    bits
        Plug-in estimate, which is positive on finite samples even where nothing is told.
    null_mean, null_high
        Mean and 95th percentile of the estimate on permuted predictions.
    """

    bits: float
    null_mean: float
    null_high: float


@dataclass(frozen=True)
class InferenceMeasures:
    """Predictions against the truth.

    Parameters
    ----------
    accuracy
        Its ``errors`` are the faces whose class was found: what a defender counts as an error.
    balanced_accuracy
        Mean over the classes that occur of the share found.
    confusion
        Counts; a row for each true class, a column for each predicted one.
    advantage
        Accuracy minus the majority's share; negative below it.
    p_value
        Two-sided, of the accuracy among permutations of the predictions.
    """

    accuracy: Rate
    balanced_accuracy: float
    confusion: tuple[tuple[int, ...], ...]
    information: MutualInformation
    baselines: Baselines
    advantage: float
    p_value: float
    leakage: Leakage

    @property
    def strength(self) -> float:
        """How far the accuracy is from that of the same predictions dealt out at random.

        Not from the majority's share, beneath which an attacker who knows nothing scores too.
        """
        return abs(self.accuracy.value - self.baselines.same_predictions)


def measure(
    predicted: Codes,
    truth: Codes,
    *,
    training: Codes,
    classes: int,
    seed: int,
    permutations: int = PERMUTATIONS,
) -> InferenceMeasures:
    """Compare predictions with the truth.

    Parameters
    ----------
    predicted, truth : (N,) int64
        Class numbers, 0 … ``classes`` − 1.
    training : (T,) int64
        Class numbers of the attacker's own faces.

    Raises
    ------
    AuditError
        There are no predictions, or not as many as truths.

    Notes
    -----
    The number of hits of permuted predictions has a mean and a variance in closed form [1]_; for
    the sizes of an audit its distribution is normal.

    References
    ----------
    .. [1] W. Hoeffding, "A combinatorial central limit theorem", Ann. Math. Statist. 22 (1951).
    """
    if not len(truth) or len(predicted) != len(truth) or not len(training):
        raise AuditError(f"{len(predicted)} predictions do not fit {len(truth)} attacked faces")
    table = confusion(predicted, truth, classes)
    of_truth, of_predicted = table.sum(axis=1), table.sum(axis=0)
    hits, count = int(np.trace(table)), len(truth)
    shares = of_truth / count
    own = np.bincount(training, minlength=classes)
    baselines = Baselines(
        uniform=1 / classes,
        majority_of_training=float(shares[int(np.argmax(own))]),
        majority=float(shares.max()),
        prior=float(shares @ shares),
        same_predictions=float(shares @ of_predicted) / count,
    )
    p_value = _two_sided(hits, of_truth, of_predicted)
    leakage = Leakage.NONE
    if p_value < SIGNIFICANCE:
        above = hits / count > baselines.same_predictions
        leakage = Leakage.ABOVE if above else Leakage.BELOW
    occurring = of_truth > 0
    return InferenceMeasures(
        accuracy=rate(hits, count),
        balanced_accuracy=float(np.mean(np.diag(table)[occurring] / of_truth[occurring])),
        confusion=tuple(tuple(map(int, row)) for row in table),
        information=_information(predicted, truth, classes, permutations, seed),
        baselines=baselines,
        advantage=hits / count - baselines.majority,
        p_value=p_value,
        leakage=leakage,
    )


def confusion(predicted: Codes, truth: Codes, classes: int) -> Codes:
    """Counts of every pair of a true (row) and a predicted class (column)."""
    pairs = np.bincount(truth * classes + predicted, minlength=classes**2)
    return np.asarray(pairs.reshape(classes, classes), dtype=np.int64)


def mutual_information(table: Codes) -> float:
    """Mutual information in bits of the row and the column of a table of counts."""
    joint = table / table.sum()
    product = np.outer(joint.sum(axis=1), joint.sum(axis=0))
    seen = joint > 0
    return max(0.0, float(np.sum(joint[seen] * np.log2(joint[seen] / product[seen]))))


def _information(
    predicted: Codes, truth: Codes, classes: int, permutations: int, seed: int
) -> MutualInformation:
    generator = np.random.default_rng(seed)
    null = [
        mutual_information(confusion(generator.permutation(predicted), truth, classes))
        for _ in range(permutations)
    ]
    bits = mutual_information(confusion(predicted, truth, classes))
    return MutualInformation(bits, float(np.mean(null)), float(np.percentile(null, 95)))


def _two_sided(hits: int, of_truth: Codes, of_predicted: Codes) -> float:
    """P-value of a number of hits among permutations, by the normal approximation."""
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
