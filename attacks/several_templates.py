"""Several templates of one person: of the same photos, and of others.

The service draws the decoys of the same photos under a secret: enrolled again, they give the same
template in another rotation, and who opens both has one. Templates of different photos come near
each other in the person. A thief without the holder's key opens neither.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.holder_keys import THEFTS, Guess, Theft
from attacks.outcomes import AttackOutcome, Knowledge, Leaked
from attacks.population import Subjects
from attacks.recovery import recovery_outcome
from attacks.stored.intersection import in_memory, nearest_common_points
from attacks.system import System
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

COUNTS = (1, 2, 3, 4, 5)
SAME = 2
"""Enrollments of the same photos."""
JUDGED_PEOPLE = 20
"""Of fewer people a share says too little to judge by."""


def several_templates(
    system: System,
    photos: Sequence[NDArray[np.float32]],
    guess: Guess,
    *,
    counts: Sequence[int] = COUNTS,
) -> list[AttackOutcome]:
    """Steal several templates of each person, with the holder's key and without it.

    Parameters
    ----------
    photos
        Of every person (k_i, n) unit rows. The last is the fresh photo; of the others, T are
        lifted, one template each. People with fewer are left out, and T that nobody reaches; T
        that fewer than 20 people reach is reported, and not judged.
    guess
        The strongest guess from one template.
    counts
        T: numbers of templates.

    Returns
    -------
    list of AttackOutcome
        Named ``several-templates``: for each T the mean of the guesses from all and, from two on,
        the point that is nearest to all; with the key kept, the largest T only. T = 1 is not
        judged: it is what the others are held against.
    """
    once = in_memory(system, "photos that are enrolled again")
    outcomes = []
    for count in (1, SAME):
        batches = [once] * count
        outcomes += _guessed(system, batches, guess, "the same photos", system.victims, count)
    reached = [count for count in counts if any(len(album) > count for album in photos)]
    for count in reached:
        enough = [album for album in photos if len(album) > count]
        batches = [
            system.lift(np.stack([album[number] for album in enough]), f"photo {number} of {count}")
            for number in range(count)
        ]
        means = np.stack([album[:count].mean(axis=0, dtype=np.float64) for album in enough])
        people = Subjects(
            enrolled=normalised(means).astype(np.float32),
            fresh=np.stack([album[-1] for album in enough]),
            photos=np.full(len(enough), count),
            shown=np.full(len(enough), -1),  # of no folder
        )
        outcomes += _guessed(system, batches, guess, "different photos", people, max(reached))
    return outcomes


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
    enough = len(people) >= JUDGED_PEOPLE
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
                ""
                if enough
                else f" (not judged: fewer than {JUDGED_PEOPLE} people have the photos)"
            ),
            judged=enough and count > 1,
            people=None if people is system.victims else people,
            details={"templates": count, "people": len(people)},
        )
        for name, points in guesses.items()
    ]
