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

from attacks.cast import LEAST_ALBUM, Person
from attacks.decisions import decide
from attacks.likelihood import likeliest_guesses
from attacks.linkage import secret_rotation
from attacks.outcomes import Knowledge, Outcome, Property
from attacks.recovery import fmr_of, recovery_outcome
from attacks.scene import Scene
from attacks.stored.foot_point import foot_points
from attacks.stored.intersection import JUDGED_PEOPLE, nearest_common_points
from attacks.stored.presentation import (
    honest_embedding,
    honest_flats,
    honest_lift,
    points_inside,
)
from templates.contract.document import Calibration
from templates.keys.rotation import rotate
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes
from verify.metrics import rate

SAME, NEW = "same photos", "new photos"


def renew(
    scene: Scene,
    photos: Sequence[NDArray[np.float32]] = (),
    *,
    guesses: Mapping[str, NDArray[np.floating]] | None = None,
) -> list[Outcome]:
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
    list of Outcome
        Named ``renewal-replay`` (acceptance of the old foot point, a point of the old template,
        the guesses, and the old template as a lifted probe) and ``renewal-intersection``
        (recovery from the old and the new template, both opened).
    """
    known = likeliest_guesses(scene) if guesses is None else guesses
    again = {
        name: scene.lift(people, f"renewal, {name}")
        for name, people in ((SAME, scene.victims.enrolled), (NEW, scene.victims.fresh))
    }
    outcomes = [each for name, new in again.items() for each in _replays(scene, new, known, name)]
    outcomes.append(_intersection(scene, scene.templates, again[SAME], SAME))
    albums = [mine for mine in photos if len(mine) >= LEAST_ALBUM]
    if albums:
        first, second, third = (np.stack([mine[number] for mine in albums]) for number in range(3))
        mean = first.astype(np.float64) + second
        people = Person(
            enrolled=(mean / np.linalg.norm(mean, axis=1, keepdims=True)).astype(np.float32),
            fresh=third,
            photos=np.full(len(albums), 2),
            shown=np.full(len(albums), -1),  # of no folder
        )
        old, new = scene.lift(first, "before a renewal"), scene.lift(second, "after a renewal")
        outcomes.append(_intersection(scene, old, new, NEW, people=people))
    return outcomes


def _intersection(
    scene: Scene,
    old: SubspaceBatch,
    new: SubspaceBatch,
    photos: str,
    *,
    people: Person | None = None,
) -> Outcome:
    judged = len(old) >= JUDGED_PEOPLE
    return recovery_outcome(
        scene,
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
    scene: Scene, new: SubspaceBatch, guesses: Mapping[str, NDArray[np.floating]], photos: str
) -> list[Outcome]:
    """Present what the old templates give to the service that holds the new ones.

    The service rotates what it is sent, by the old key or by a new one: so a new rotation guards
    nothing where the old one leaked and the attacker can open the old template, and where it did
    not leak, either turns the stored form away from what it was. Guesses need the template opened.
    """
    old = scene.templates
    points: dict[str, NDArray[np.floating]] = {
        "old foot point": foot_points(old),
        "a point of the old template": points_inside(old, seed=scene.seed),
    }
    likely = {f"likeliest guess, {name}": rows for name, rows in guesses.items()}
    turn = secret_rotation(scene, "breached")
    found: list[Outcome] = []
    for leaked in (True, False):
        setting = f"{photos}, old rotation {'leaked' if leaked else 'secret'}"
        for name, rows in (points | likely if leaked else points).items():
            shown = rows if leaked else rotate(rows, turn)
            probes = np.ascontiguousarray(shown, dtype=np.float32)
            passed = honest_embedding(probes)
            variant = f"{setting}, {name}"
            found += _replay(scene, probes, passed, new, scene.points, variant, leaked=leaked)
        if scene.lifted is not None and scene.lifted.probe_m <= old.m:
            flats = honest_flats(old, scene.lifted)
            lifts = flats if leaked else flats.rotated(turn)
            passed = honest_lift(lifts, scene.lifted)
            variant = f"{setting}, old template as a lifted probe"
            found += _replay(scene, lifts, passed, new, scene.lifted, variant, leaked=leaked)
    return found


def _replay(
    scene: Scene,
    probes: Probes,
    passed: NDArray[np.bool_],
    new: SubspaceBatch,
    calibration: Calibration,
    variant: str,
    *,
    leaked: bool,
) -> list[Outcome]:
    """Report acceptance; empty where the calibration lacks the service's default level."""
    level = next((each for each in calibration.levels if each.name == scene.level.name), None)
    if level is None:
        return []
    decided = decide(probes, new, scene.contract, calibration, level, paired=True)
    accepted = decided.accepted & passed
    return [
        Outcome(
            attack="renewal-replay",
            variant=variant,
            breaks=Property.RENEWABILITY,
            knowledge=Knowledge.KEY if leaked else Knowledge.ALGORITHM,
            assumption="The template from before the renewal, the old rotation "
            f"{'leaked' if leaked else 'secret'}, and the right to send embeddings or templates; "
            "success is acceptance against the renewed template, after the input checks, which a "
            "new rotation does not change",
            scheme=scene.scheme,
            level=level.name,
            measured=rate(int(np.count_nonzero(accepted)), len(new)),
            chance=fmr_of(level),
            details={
                "accepted_without_cohort_test": float(decided.near.mean()),
                "refused_by_the_input_checks": int(np.count_nonzero(~passed)),
            },
        )
    ]
