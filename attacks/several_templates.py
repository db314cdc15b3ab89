"""Several templates of one person: of the same photos, of some of them, and of others.

The service draws the decoys of the same photos under a secret: enrolled again, they give the same
template in another rotation, and who opens both has one. Two secrets give two lifts, which come
near each other in the descriptor: what two tenants, or two names, have of a person who keeps a key
and gave both the same photos. Photos that overlap those of an earlier enrollment give two lifts
of nearly one descriptor, and different photos come near each other in the person. A thief without
the holder's key opens none of them.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.holder_keys import KEPT, STOLEN, THEFTS, Guess, Theft
from attacks.outcomes import AttackOutcome, Knowledge, Leaked, judged_by_controls
from attacks.population import Subjects
from attacks.recovery import recovery_outcome
from attacks.stored.intersection import nearest_common_points
from attacks.system import System
from enroll import Enroller
from templates.contract import wire
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import TenantRotation
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

COUNTS = (1, 2, 3, 4, 5)
"""T: numbers of templates."""
SAME, TWO_SECRETS = "the same photos", "the same photos under two lift secrets"
OVERLAPS = {
    "two of three photos the same": ((0, 1, 2), (0, 1, 3)),
    "one photo more": ((0, 1), (0, 1, 2)),
}
"""Photos of two enrollments that overlap."""
JUDGED_PEOPLE = 20
"""Of fewer people a share says too little to judge by."""


def several_templates(
    system: System, photos: Sequence[NDArray[np.float32]], guess: Guess
) -> list[AttackOutcome]:
    """Steal several templates of each person, with the holder's key and without it.

    Parameters
    ----------
    photos
        Of every person (k_i, n) unit rows. The last is the fresh photo; of the others, T are
        lifted, one template each. People with fewer are left out, and T that nobody reaches; T
        that fewer than 20 people reach is reported, and not judged.

    Returns
    -------
    list of AttackOutcome
        Named ``several-templates``: for each T the mean of the guesses from all and, from two on,
        the point that is nearest to all; with the key kept, the largest T only, judged where the
        same guess succeeds with the key. T = 1 is not judged: it is what the others are held
        against.
    """
    first, again = (enrolled(system, "the deployment's secret") for _ in range(2))
    other = enrolled(system, "another secret")
    outcomes = [
        outcome
        for batches, name in (
            ([first], SAME),
            ([first, again], SAME),
            ([first, other], TWO_SECRETS),
        )
        for outcome in _guessed(system, batches, guess, name, system.victims, len(batches))
    ]
    for name, chosen in OVERLAPS.items():
        enough = [album for album in photos if len(album) > max(map(max, chosen)) + 1]
        if enough:
            batches = [
                system.lift(_means(enough, numbers), f"{name}, photos {numbers}")
                for numbers in chosen
            ]
            people = _people(enough, _means(enough, range(max(map(max, chosen)) + 1)))
            outcomes += _guessed(system, batches, guess, name, people, len(batches))
    reached = [count for count in COUNTS if any(len(album) > count for album in photos)]
    for count in reached:
        enough = [album for album in photos if len(album) > count]
        batches = [
            system.lift(np.stack([album[number] for album in enough]), f"photo {number} of {count}")
            for number in range(count)
        ]
        people = _people(enough, _means(enough, range(count)))
        outcomes += _guessed(system, batches, guess, "different photos", people, max(reached))
    return judged_by_controls(outcomes, KEPT, STOLEN)


def enrolled(system: System, secret: str) -> SubspaceBatch:
    """Enroll the victims as a service does, and undo the tenant's rotations.

    Parameters
    ----------
    secret
        Names the deployment's secret that decoys are drawn under.
    """
    contract = system.contract
    with Keystream.seeded("audit", system.seed, "lift secret", secret) as stream:
        rotation = TenantRotation(stream.token(KEY_BYTES), system.templates.n)
        enroller = Enroller(
            contract,
            system.lifter.source,
            rotation=rotation,
            lift_secret=stream.token(KEY_BYTES),
        )
    templates = []
    for row in system.victims.enrolled:
        stored = enroller.from_embeddings(row[None])
        turned = wire.decode(stored.wire).subspace
        own = rotation.of(stored.template_id, contract.binding.rotation_version)
        templates.append(turned.turned_by(own.turned_back))
    return SubspaceBatch.of(templates)


def _means(albums: Sequence[NDArray[np.float32]], numbers: Sequence[int]) -> NDArray[np.float32]:
    """Descriptors of some photos of every person, (V, n)."""
    means = [album[list(numbers)].mean(axis=0, dtype=np.float64) for album in albums]
    return normalised(np.stack(means)).astype(np.float32)


def _people(albums: Sequence[NDArray[np.float32]], descriptors: NDArray[np.float32]) -> Subjects:
    """The people of some albums, whose last photo is the fresh one."""
    return Subjects(
        enrolled=descriptors,
        fresh=np.stack([album[-1] for album in albums]),
        photos=np.full(len(albums), 1),
        shown=np.full(len(albums), -1),  # of no folder
    )


def _guessed(
    system: System,
    batches: Sequence[SubspaceBatch],
    guess: Guess,
    photos: str,
    people: Subjects,
    most: int,
) -> list[AttackOutcome]:
    """Guess from T templates of each of V people, ``batches``: T of V templates."""
    return [
        outcome
        for theft in THEFTS
        if theft.leaked is Leaked.HOLDER_KEYS or len(batches) == most > 1
        for outcome in _of_theft(system, batches, guess, photos, people, theft)
    ]


def _of_theft(
    system: System,
    batches: Sequence[SubspaceBatch],
    guess: Guess,
    photos: str,
    people: Subjects,
    theft: Theft,
) -> list[AttackOutcome]:
    count = len(batches)
    seen = [
        theft.of(system, batch, f"{photos}, enrollment {number}")
        for number, batch in enumerate(batches)
    ]
    guesses = {
        "mean of the likeliest": normalised(np.sum([guess(batch) for batch in seen], axis=0))
    }
    if count > 1:
        guesses["nearest to all"] = nearest_common_points(seen)
    unjudged = None
    if len(people) < JUDGED_PEOPLE:
        unjudged = f"fewer than {JUDGED_PEOPLE} people have the photos"
    elif count == 1:
        unjudged = "one template is judged by the attacks on one"
    return [
        recovery_outcome(
            system,
            points,
            attack="several-templates",
            variant=f"{photos}, {count} templates, {name}, {theft.variant}",
            leaked=theft.leaked,
            knowledge=Knowledge.TEMPLATES,
            assumption=f"{theft.assumption}: {count} templates of each person, of {photos}; "
            "success is a match of the guess with a photo of none of them"
            + (
                " (what two tenants, or two names, have of who keeps a key)"
                if photos == TWO_SECRETS
                else ""
            ),
            unjudged=unjudged,
            people=None if people is system.victims else people,
            details={"templates": count, "people": len(people)},
        )
        for name, points in guesses.items()
    ]
