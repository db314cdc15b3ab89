"""Runs an attack: its results are scored, its controls made, its rows judged, for all alike."""

from attacks.attack import Attack
from attacks.bed import Testbed
from attacks.linked import linked
from attacks.outcomes import AttackOutcome, Property
from attacks.presented import presented
from attacks.recovery import recovered, several_templates


def run_attack(attack: Attack, bed: Testbed) -> list[AttackOutcome]:
    """Make an attack on the victims' templates, with its controls; a row for each variant."""
    if attack.breaks is Property.UNLINKABILITY:
        return linked(attack, bed)
    if attack.needs.several:
        return [row for beds in several_templates(bed) for row in recovered(attack, *beds)]
    if attack.breaks is Property.IRREVERSIBILITY:
        return recovered(attack, bed)
    return presented(attack, bed)
