"""A row of the attribute report: one attacker, one attribute, one scheme."""

from collections.abc import Iterable
from dataclasses import dataclass

from attacks.attributes.measures import InferenceMeasures
from attacks.outcomes import KnowledgeLevel, Scheme
from templates.contract.canonical import Json
from templates.distances import Metric


@dataclass(frozen=True, kw_only=True)
class AttributeRow:
    """How well one attacker infers one attribute.

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
    held_out
        The attacker's strength (`InferenceMeasures.strength`) on faces that it lifted itself and
        did not learn from, of ``knn`` on all that it lifted: what it chooses the best attacker by,
        before it sees a victim.
    seconds
        Time that this attacker took for all attributes, without lifting and neighbour search where
        others share them.
    """

    scheme: Scheme
    attribute: str
    attacker: str
    metric: Metric | None
    knowledge: KnowledgeLevel
    classes: tuple[str, ...]
    measures: InferenceMeasures
    held_out: float
    seed: int
    seconds: float

    @property
    def accuracy(self) -> float:
        """Share of the attacked faces whose class was found."""
        return self.measures.accuracy.value

    @property
    def chance(self) -> float:
        """Share of the largest class of the attacked faces."""
        return self.measures.baselines.majority

    @property
    def chance_of_predictions(self) -> float:
        """Share that the same predictions find if dealt out at random; leakage counts from it."""
        return self.measures.baselines.same_predictions

    def to_json(self) -> dict[str, Json]:
        """Return a row of ``rows`` of the report."""
        measures = self.measures
        return {
            **self.scheme.to_json(),
            "attribute": self.attribute,
            "attacker": self.attacker,
            "metric": None if self.metric is None else str(self.metric),
            "knowledge": str(self.knowledge),
            "seed": self.seed,
            "accuracy": self.accuracy,
            "chance": self.chance,
            "chance_of_predictions": self.chance_of_predictions,
            "correct": measures.accuracy.errors,
            "trials": measures.accuracy.trials,
            "ci_low": measures.accuracy.ci_low,
            "ci_high": measures.accuracy.ci_high,
            "balanced_accuracy": measures.balanced_accuracy,
            "mutual_information_bits": measures.information.bits,
            "mutual_information_null": {
                "mean": measures.information.null_mean,
                "percentile_95": measures.information.null_high,
            },
            "classes": list(self.classes),
            "confusion": [list(row) for row in measures.confusion],
            "baselines": measures.baselines.to_json(),
            "advantage": measures.advantage,
            "p_value": measures.p_value,
            "leakage": str(measures.leakage),
            "held_out_strength": self.held_out,
            "seconds": self.seconds,
        }


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
