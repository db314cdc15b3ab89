"""What a stolen template is worth once the victim has enrolled anew (ISO/IEC 24745 renewability).

The renewal is from the same photos, which give the same template in another rotation, or from new
ones. Against each, the attacker presents what it stole. What two opened templates of one person
tell is measured in ``attacks.several_templates``.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import decide
from attacks.linkage import rotations_of, turned, turned_points
from attacks.outcomes import AttackOutcome, Knowledge, Leaked, Property, judged_by_controls
from attacks.recovery import fmr_of
from attacks.stored.foot_point import foot_points
from attacks.stored.honest_probes import (
    honest_embedding,
    honest_flats,
    honest_lift,
    points_inside,
)
from attacks.system import System
from templates.contract.document import Calibration
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes
from verify.metrics import rate

SAME, NEW = "same photos", "new photos"
_SECRET, _LEAKED = "old rotation secret", "old rotation leaked"


def renew(system: System, *, guesses: Mapping[str, NDArray[np.floating]]) -> list[AttackOutcome]:
    """Attack the victims' renewed templates with the old ones.

    Parameters
    ----------
    guesses
        Guesses of the victims' embeddings from the old templates alone, by name, (V, k).

    Returns
    -------
    list of AttackOutcome
        Named ``renewal-replay``: acceptance of the old foot point, a point of the old template,
        the guesses, and the old template as a lifted probe. With the old rotation secret a row is
        judged where the same probe is accepted once that leaked.
    """
    renewed = {SAME: system.templates, NEW: system.renewed}
    outcomes = [
        outcome for name, new in renewed.items() for outcome in _replays(system, new, guesses, name)
    ]
    return judged_by_controls(outcomes, _SECRET, _LEAKED)


def _replays(
    system: System, new: SubspaceBatch, guesses: Mapping[str, NDArray[np.floating]], photos: str
) -> list[AttackOutcome]:
    """Present what the old templates give to the service that holds the new ones.

    The service turns what it is sent by the new template's rotation: so that guards nothing where
    the old one leaked and the attacker can open the old template, and where it did not leak, turns
    the stored form away from what it was. Guesses need the template opened.
    """
    old = system.templates
    points: dict[str, NDArray[np.floating]] = {
        "old foot point": foot_points(old),
        "a point of the old template": points_inside(old, seed=system.seed),
    }
    likely = {f"likeliest guess, {name}": rows for name, rows in guesses.items()}
    turns = rotations_of(system, "breached", "template", len(old))
    outcomes: list[AttackOutcome] = []
    for leaked in (True, False):
        setting = f"{photos}, {_LEAKED if leaked else _SECRET}"
        for name, rows in (points | likely if leaked else points).items():
            shown = rows if leaked else turned_points(rows, turns)
            probes = np.ascontiguousarray(shown, dtype=np.float32)
            passed = honest_embedding(probes)
            variant = f"{setting}, {name}"
            outcomes += _replay(system, probes, passed, new, system.points, variant, leaked=leaked)
        if system.lifted is not None and system.lifted.probe_m <= old.m:
            flats = honest_flats(old, system.lifted)
            lifts = flats if leaked else turned(flats, turns)
            passed = honest_lift(lifts, system.lifted)
            variant = f"{setting}, old template as a lifted probe"
            outcomes += _replay(system, lifts, passed, new, system.lifted, variant, leaked=leaked)
    return outcomes


def _replay(
    system: System,
    probes: Probes,
    passed: NDArray[np.bool_],
    new: SubspaceBatch,
    calibration: Calibration,
    variant: str,
    *,
    leaked: bool,
) -> list[AttackOutcome]:
    """Report acceptance; empty where the calibration lacks the service's default level."""
    level = next(
        (candidate for candidate in calibration.levels if candidate.name == system.level.name), None
    )
    if level is None:
        return []
    decided = decide(probes, new, system.nobody, calibration, level, paired=True)
    accepted = decided & passed
    return [
        AttackOutcome(
            attack="renewal-replay",
            variant=variant,
            breaks=Property.RENEWABILITY,
            leaked=Leaked.HOLDER_KEYS if leaked else Leaked.MASTER_KEY,
            knowledge=Knowledge.ALGORITHM,
            assumption="The template from before the renewal, the "
            f"{_LEAKED if leaked else _SECRET}, and the right to send embeddings or templates; "
            "success is acceptance against the renewed template, after the input checks, which a "
            "new rotation does not change",
            scheme=system.scheme,
            level=level.name,
            measured=rate(int(np.count_nonzero(accepted)), len(new)),
            chance=fmr_of(level),
            details={
                "refused_by_the_input_checks": int(np.count_nonzero(~passed)),
            },
        )
    ]
