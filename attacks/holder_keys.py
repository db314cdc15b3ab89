"""Everything is stolen but the keys that people keep: what their templates then give.

The thief has the database and every secret of the deployment, and undoes the tenants' rotations.
A template whose holder keeps a key is still turned by a rotation that nothing stolen gives
(docs/method.md §4.9). Beside each attack stands the same one with the key stolen too, and beside
both, on templates of so few decoys that it must succeed, what shows that it is an attack at all.
``attacks.linkage`` has two such templates, ``attacks.several_templates`` several of one person.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.linkage import holder_rotations_of, turned, turned_back
from attacks.outcomes import CONTROL, AttackOutcome, Knowledge, Leaked, judged_by_controls
from attacks.recovery import recovery_outcome
from attacks.stored.foot_point import foot_points
from attacks.stored.second_moments import ATTACK, Guesser
from attacks.system import System
from templates.space.subspace import SubspaceBatch
from verify.comparisons import through_wire

Guess = Callable[[SubspaceBatch], NDArray[np.floating]]
"""Guesses the descriptor of every template, (T, n)."""


CONTROL_DIM = 4
"""Dimension of the templates that show that the attacks work."""


@dataclass(frozen=True)
class Theft:
    """What was stolen of templates whose holders keep a key."""

    leaked: Leaked
    variant: str
    assumption: str

    def of(self, system: System, batch: SubspaceBatch, enrollment: str) -> SubspaceBatch:
        """Return templates as this thief sees them, stored under their holders' keys.

        Parameters
        ----------
        enrollment
            Its name: a person's key gives each enrollment another rotation.
        """
        rotations = holder_rotations_of(system, enrollment, len(batch))
        stored = through_wire(turned(batch, rotations), contract_id=system.contract.contract_id)
        return stored if self.leaked is Leaked.MASTER_KEY else turned_back(stored, rotations)


KEPT, STOLEN = "holder's key kept", "holder's key stolen"
THEFTS = (
    Theft(
        Leaked.MASTER_KEY,
        KEPT,
        "The database and every secret of the deployment are stolen, and the key of the holder is "
        "not, whose rotation still turns the template",
    ),
    Theft(
        Leaked.HOLDER_KEYS,
        STOLEN,
        "The database, every secret of the deployment and the holder's key are stolen",
    ),
)


def guess_with_and_without_holder_keys(
    system: System, guesses: Mapping[str, Guess]
) -> list[AttackOutcome]:
    """Guess the victims' descriptors from templates whose holders keep a key.

    Returns
    -------
    list of AttackOutcome
        For each attack the key kept, and the key stolen: a control, which is not judged, because
        the same attack on un-rotated templates is. Where it fails too, the key kept is not judged.
    """
    outcomes: list[AttackOutcome] = []
    for theft in THEFTS:
        seen = theft.of(system, system.templates, "enrollment")
        control = theft.leaked is Leaked.HOLDER_KEYS
        outcomes += [
            recovery_outcome(
                system,
                guess(seen),
                attack=attack,
                variant=theft.variant,
                leaked=theft.leaked,
                knowledge=Knowledge.ALGORITHM,
                assumption=f"{theft.assumption}; the attack is the one on an un-rotated template; "
                "success is a match of the guess with a fresh photo"
                + (" (a control)" if control else ""),
                unjudged=CONTROL if control else None,
            )
            for attack, guess in guesses.items()
        ]
    return judged_by_controls(outcomes, KEPT, STOLEN)


def guess_from_few_decoys(system: System) -> list[AttackOutcome]:
    """Make the same attacks on templates of m = 4: a control, which is not judged.

    Returns
    -------
    list of AttackOutcome
        Foot point and second moments, with the key kept and stolen; none where the system's own
        templates are of no more dimensions.
    """
    if system.scheme.dim <= CONTROL_DIM:
        return []
    templates = system.lift(system.victims.enrolled, "few decoys", m=CONTROL_DIM)
    guesses: dict[str, Guess] = {
        "foot-point": foot_points,
        ATTACK: Guesser(system),
    }
    return [
        recovery_outcome(
            system,
            guess(theft.of(system, templates, "few decoys")),
            attack=attack,
            variant=f"{theft.variant}, m = {CONTROL_DIM}",
            leaked=theft.leaked,
            knowledge=Knowledge.ALGORITHM,
            assumption=f"{theft.assumption}; the template is of m = {CONTROL_DIM}, at which the "
            "attack must succeed with the key; success is a match of the guess with a fresh photo "
            "(a control)",
            unjudged=CONTROL,
        )
        for theft in THEFTS
        for attack, guess in guesses.items()
    ]
