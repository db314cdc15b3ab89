"""What a stolen template is worth once the victim has enrolled anew (ISO/IEC 24745 renewability).

The renewal is from the same photos, which give the same descriptor, or from new ones. Against
each, the attacker presents what it stole; and, where the tenant's rotation leaked and was kept,
steals the new template as well and looks where the two meet. Under a new rotation the second
template is noise to whoever cannot open it, and an attacker passes over it: what the first one
tells is what ``attacks.likelihood`` and the replays here report.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import decide
from attacks.likelihood import likeliest_guesses
from attacks.linkage import secret_rotation
from attacks.outcomes import AttackOutcome, Knowledge, Property
from attacks.population import LEAST_ALBUM, Subjects
from attacks.recovery import fmr_of, recovery_outcome
from attacks.stored.foot_point import foot_points
from attacks.stored.honest_probes import (
    honest_embedding,
    honest_flats,
    honest_lift,
    points_inside,
)
from attacks.stored.intersection import JUDGED_PEOPLE, nearest_common_points
from attacks.system import System
from templates.contract.document import Calibration
from templates.keys.rotation import rotate
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes
from verify.metrics import rate

SAME, NEW = "same photos", "new photos"


def renew(
    system: System,
    photos: Sequence[NDArray[np.float32]] = (),
    *,
    guesses: Mapping[str, NDArray[np.floating]] | None = None,
) -> list[AttackOutcome]:
    """Attack the victims' renewed templates with the old ones.

    Parameters
    ----------
    photos
        Of each of some people, victims or others, (k_i, n) descriptors of their photos. The old
        template is of the first, the new one of the second, and the third tells whether their
        intersection succeeded. People with fewer than three are left out; without any, so is the
        intersection under new photos.
    guesses
        Guesses of the victims' descriptors from the old templates alone, by name, (V, n); those
        of :func:`attacks.likelihood.likeliest_guesses` where None.

    Returns
    -------
    list of AttackOutcome
        Named ``renewal-replay`` (acceptance of the old foot point, a point of the old template,
        the guesses, and the old template as a lifted probe) and ``renewal-intersection``
        (recovery from the old and the new template, both opened).
    """
    known = likeliest_guesses(system) if guesses is None else guesses
    renewed = {
        name: system.lift(people, f"renewal, {name}")
        for name, people in ((SAME, system.victims.enrolled), (NEW, system.victims.fresh))
    }
    outcomes = [
        outcome for name, new in renewed.items() for outcome in _replays(system, new, known, name)
    ]
    outcomes.append(_intersection(system, system.templates, renewed[SAME], SAME))
    albums = [album for album in photos if len(album) >= LEAST_ALBUM]
    if albums:
        first, second, third = (
            np.stack([album[number] for album in albums]) for number in range(3)
        )
        mean = first.astype(np.float64) + second
        people = Subjects(
            enrolled=(mean / np.linalg.norm(mean, axis=1, keepdims=True)).astype(np.float32),
            fresh=third,
            photos=np.full(len(albums), 2),
            shown=np.full(len(albums), -1),  # of no folder
        )
        old, new = system.lift(first, "before a renewal"), system.lift(second, "after a renewal")
        outcomes.append(_intersection(system, old, new, NEW, people=people))
    return outcomes


def _intersection(
    system: System,
    old: SubspaceBatch,
    new: SubspaceBatch,
    photos: str,
    *,
    people: Subjects | None = None,
) -> AttackOutcome:
    judged = len(old) >= JUDGED_PEOPLE
    return recovery_outcome(
        system,
        nearest_common_points([old, new]),
        attack="renewal-intersection",
        variant=f"{photos}, same rotation",
        knowledge=Knowledge.TEMPLATES,
        assumption="The template before and the one after a renewal, both opened with the leaked "
        "rotation, which was kept; the guess is the point nearest to both; success is a match of "
        "the raw guess with "
        + ("a fresh photo" if people is None else "a third photo, of which neither was lifted")
        + ("" if judged else f" (not judged: fewer than {JUDGED_PEOPLE} people have the photos)"),
        breaks=Property.RENEWABILITY,
        judged=judged,
        people=people,
        details={"people": len(old)},
    )


def _replays(
    system: System, new: SubspaceBatch, guesses: Mapping[str, NDArray[np.floating]], photos: str
) -> list[AttackOutcome]:
    """Present what the old templates give to the service that holds the new ones.

    The service rotates what it is sent, by the old key or by a new one: so a new rotation guards
    nothing where the old one leaked and the attacker can open the old template, and where it did
    not leak, either turns the stored form away from what it was. Guesses need the template opened.
    """
    old = system.templates
    points: dict[str, NDArray[np.floating]] = {
        "old foot point": foot_points(old),
        "a point of the old template": points_inside(old, seed=system.seed),
    }
    likely = {f"likeliest guess, {name}": rows for name, rows in guesses.items()}
    turn = secret_rotation(system, "breached")
    outcomes: list[AttackOutcome] = []
    for leaked in (True, False):
        setting = f"{photos}, old rotation {'leaked' if leaked else 'secret'}"
        for name, rows in (points | likely if leaked else points).items():
            shown = rows if leaked else rotate(rows, turn)
            probes = np.ascontiguousarray(shown, dtype=np.float32)
            passed = honest_embedding(probes)
            variant = f"{setting}, {name}"
            outcomes += _replay(system, probes, passed, new, system.points, variant, leaked=leaked)
        if system.lifted is not None and system.lifted.probe_m <= old.m:
            flats = honest_flats(old, system.lifted)
            lifts = flats if leaked else flats.rotated(turn)
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
    decided = decide(probes, new, system.contract, calibration, level, paired=True)
    accepted = decided.accepted & passed
    return [
        AttackOutcome(
            attack="renewal-replay",
            variant=variant,
            breaks=Property.RENEWABILITY,
            knowledge=Knowledge.KEY if leaked else Knowledge.ALGORITHM,
            assumption="The template from before the renewal, the old rotation "
            f"{'leaked' if leaked else 'secret'}, and the right to send embeddings or templates; "
            "success is acceptance against the renewed template, after the input checks, which a "
            "new rotation does not change",
            scheme=system.scheme,
            level=level.name,
            measured=rate(int(np.count_nonzero(accepted)), len(new)),
            chance=fmr_of(level),
            details={
                "accepted_without_cohort_test": float(decided.near.mean()),
                "refused_by_the_input_checks": int(np.count_nonzero(~passed)),
            },
        )
    ]
