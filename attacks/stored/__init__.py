"""Attacks on stored templates: what a thief of templates learns, and which probes open them."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import Outcome
from attacks.scene import Scene
from attacks.stored.foot_point import foot_point_attack
from attacks.stored.impersonation import impersonation_attack
from attacks.stored.intersection import different_photos, same_descriptor
from attacks.stored.known_database import known_database_attack
from attacks.stored.nearest_neighbour import nearest_neighbour_attack
from attacks.stored.oracle import oracle_attack
from attacks.stored.presentation import presentation_attack

SOME = 150
"""Victims of the oracle, whose curve needs no more."""
FEW = 60
"""Victims whose descriptor is lifted again and again: it is recovered in every trial or in none."""

__all__ = [
    "different_photos",
    "foot_point_attack",
    "impersonation_attack",
    "known_database_attack",
    "nearest_neighbour_attack",
    "oracle_attack",
    "presentation_attack",
    "same_descriptor",
    "template_attacks",
]


def template_attacks(
    scene: Scene,
    *,
    photos: Sequence[NDArray[np.float32]] = (),
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> list[Outcome]:
    """Run all attacks on stored templates, in order.

    Parameters
    ----------
    photos
        Of each of some people, victims or others, (k_i, n) descriptors of their photos, for the
        intersection of different photos.
    progress
        Called with what is being done and the share of the whole, which rises from 0 to 1.
    """
    attacks: list[tuple[str, Callable[[Scene], list[Outcome]]]] = [
        ("foot point", foot_point_attack),
        ("known database", known_database_attack),
        ("nearest neighbour", nearest_neighbour_attack),
        ("oracle", lambda staged: oracle_attack(staged.first(SOME))),
        ("intersection of one descriptor", lambda staged: same_descriptor(staged.first(FEW))),
        ("intersection of photos", lambda staged: different_photos(staged, photos)),
        ("impersonation", impersonation_attack),
        ("presentation", presentation_attack),
    ]
    outcomes: list[Outcome] = []
    for number, (what, attack) in enumerate(attacks):
        progress(what, number / len(attacks))
        outcomes += attack(scene)
    progress("attacks on templates", 1.0)
    return outcomes
