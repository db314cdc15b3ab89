"""Second moments: the strongest guess of an embedding, by the attackers of a calibration's verdict.

``attacks.second_order`` has the guess, ``attacks.privacy`` the attackers.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import CONTROL, AttackOutcome, Knowledge, Leaked, Property
from attacks.privacy import (
    LEAST_FACES,
    LEAST_VICTIMS,
    AttackSetup,
    Pairs,
    TestBed,
    Theft,
    all_thefts,
)
from attacks.second_order import Moments, decoy_moment, drawn_towards, likeliest_embeddings
from attacks.system import System
from templates.decoys import DecoySource
from templates.space.subspace import SubspaceBatch

ATTACK = "second-moments"


def audit_setup(
    victims: Pairs,
    faces: NDArray[np.float32],
    people: Sequence[str],
    source: DecoySource,
    *,
    seed: int,
) -> AttackSetup:
    """Prepare the attackers from all photos of named other people, (A, n).

    A photo of a person without a name is taken for one of a person of its own.
    """
    names = [name or f"\0{number}" for number, name in enumerate(people)]
    owners = np.unique(np.asarray(names, dtype=np.str_), return_inverse=True)[1]
    return AttackSetup.of(victims, faces, source, owners=owners, seed=seed)


def second_moments_attack(system: System, setup: AttackSetup, *, kind: str) -> list[AttackOutcome]:
    """Attack as a calibration's verdict does: success is a match at raw FMR 1e-3.

    Parameters
    ----------
    kind
        Where the attacker's faces are from, in words.

    Returns
    -------
    list of AttackOutcome
        One for each attacker; of the strongest also a control, which is not judged: its guesses
        scored against photos of the next victim.
    """
    thefts = all_thefts(setup, system.strategy, axes=system.source.k, m=system.scheme.dim)[1:]
    most = max(theft.faces or 0 for theft in thefts)
    few = None
    if len(setup.victims) < LEAST_VICTIMS or most < LEAST_FACES:
        few = f"it takes {LEAST_VICTIMS} victims and {LEAST_FACES:,} faces of others"
    strongest = max(thefts, key=lambda theft: theft.found.value)

    def outcome(theft: Theft, *, control: bool = False) -> AttackOutcome:
        share = "" if theft.share == 1 else f", {theft.share:g} of decoys' moments"
        faces = "unlimited" if theft.faces is None else f"{theft.faces:,}"
        return AttackOutcome(
            attack=ATTACK,
            variant=f"photos of other people, {faces}"
            if control
            else f"{faces} faces, {theft.counted}{share}",
            breaks=Property.IRREVERSIBILITY,
            leaked=Leaked.HOLDER_KEYS,
            knowledge=Knowledge.ALGORITHM,
            assumption="One template, the decoy generator and "
            + (
                "the exact second moments of the people: people are drawn whose moments are as far "
                "from the decoys' as those of the faces are"
                if theft.faces is None
                else f"{faces} faces of {kind} ({theft.counted})"
            )
            + "; the guess is the point of the template that is most like a face, given what "
            "decoys do; success is a match of the guess with a fresh photo "
            + ("of another victim (a control)" if control else "at raw FMR 1e-3"),
            scheme=system.scheme,
            level="fmr-1e-3",
            measured=theft.control if control else theft.found,
            chance=1e-3,
            unjudged=CONTROL if control else None,
            details={
                "faces": theft.faces or "unlimited",
                "counted": theft.counted,
                "share_of_decoys": theft.share,
                "faces_from": kind,
                "too_few": few,
            },
        )

    return [*map(outcome, thefts), outcome(strongest, control=True)]


class Guesser:
    """The guess of the attacker with all faces of a system, for templates of any dimension.

    Parameters
    ----------
    faces : (A, k) float32
    """

    def __init__(self, system: System) -> None:
        decoys = Moments.of(decoy_moment(system.source))
        self._faces = Moments.of(drawn_towards(system.attacker, decoys.moment))
        self._bed = TestBed(
            Pairs(system.victims.enrolled, system.victims.fresh),
            system.source,
            decoys,
            (),
            1.0,
            system.seed,
        )
        self._strategy = system.strategy

    def __call__(self, templates: SubspaceBatch) -> NDArray[np.float64]:
        """Guess the embeddings of T templates, (T, k)."""
        forms = self._bed.decoy_forms(self._strategy, templates.m)
        # Of templates with random directions the share that was best on real faces.
        decoys = forms[min(1, len(forms) - 1)][1]
        return likeliest_embeddings(templates, self._faces, decoys)
