"""Attribute inference as the verdict sees it: the strongest attacker of each kind."""

from collections.abc import Sequence

from attacks.attributes.rows import AttributeRow, strongest
from attacks.outcomes import Knowledge, Outcome, Property, Scheme

ATTACK = "attribute-inference"
_HAS = {
    Knowledge.ALGORITHM: "One template, how templates are lifted, and labelled faces of other "
    "people, which it lifts itself to learn from",
    Knowledge.DECOYS: "The same, and the pool that the decoys were drawn from",
}


def attribute_outcomes(rows: Sequence[AttributeRow], *, audited: Scheme) -> list[Outcome]:
    """Report the strongest attacker on each scheme and attribute, by what it knows.

    The strongest is chosen on faces of the attacker's own (see ``attributes.rows.strongest``).
    Chance is what its very predictions would score dealt out at random: an attacker who knows
    nothing stays below the majority's share, and would seem to know something.

    Parameters
    ----------
    rows
        Of all schemes.
    audited
        The scheme that is judged; the others are reported to compare with.
    """
    return [
        Outcome(
            attack=ATTACK,
            variant=f"{attribute} by {row.attacker}",
            breaks=Property.CONFIDENTIALITY,
            knowledge=knowledge,
            assumption=f"{_HAS[knowledge]}; success is the right {attribute}.",
            scheme=scheme,
            measured=row.measures.accuracy,
            chance=row.chance_of_predictions,
            judged=scheme == audited,
            details={
                "majority": row.chance,
                "balanced_accuracy": row.measures.balanced_accuracy,
                "leakage": str(row.measures.leakage),
                "chosen_among": "the attacker's own held-out faces",
            },
        )
        for (scheme, attribute, knowledge), row in strongest(rows).items()
    ]
