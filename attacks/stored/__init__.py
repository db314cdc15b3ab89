"""Attacks on stored templates: what a thief of templates learns, and which probes open them."""

from attacks.outcomes import AttackOutcome
from attacks.stored.foot_point import foot_point_attack
from attacks.stored.known_database import known_database_attack
from attacks.stored.nearest_neighbour import nearest_neighbour_attack
from attacks.stored.oracle import oracle_attack
from attacks.stored.presentation import presentation_attack
from attacks.system import System

SOME = 150
"""Victims of the oracle, whose curve needs no more."""


def template_attacks(system: System) -> list[AttackOutcome]:
    """Run all attacks on stored templates, in order."""
    return [
        *foot_point_attack(system),
        *known_database_attack(system),
        *nearest_neighbour_attack(system),
        *oracle_attack(system.first(SOME)),
        *presentation_attack(system),
    ]
