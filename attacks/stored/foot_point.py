"""The foot point: for a unit descriptor d, cos(d, p) = ‖p‖ exactly (docs/method.md §4.1)."""

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import AttackOutcome, Knowledge
from attacks.recovery import recovery_outcome
from attacks.system import System
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch


def foot_points(templates: SubspaceBatch) -> NDArray[np.float64]:
    """Return p / ‖p‖ of every template, shape (T, n)."""
    return normalised(templates.feet.astype(np.float64))


def foot_point_attack(system: System) -> list[AttackOutcome]:
    """Guess p / ‖p‖, from one template and nothing else."""
    guesses = foot_points(system.templates)
    cosines = np.einsum("ij,ij->i", guesses, system.victims.enrolled.astype(np.float64))
    norms = system.templates.foot_norms
    return [
        recovery_outcome(
            system,
            guesses,
            attack="foot-point",
            knowledge=Knowledge.TEMPLATE,
            assumption=(
                "The attacker has one template and nothing else, and guesses the direction of its "
                "foot point; success is a match with a fresh photo of the victim."
            ),
            details={
                "foot_norm_mean": float(norms.mean()),
                "largest_gap_of_cosine_to_foot_norm": float(np.abs(cosines - norms).max()),
            },
        )
    ]
