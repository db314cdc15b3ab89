"""Several templates of one person: of the same photos, of some of them, and of others.

The service draws the decoys of the same photos under a secret: enrolled again, they give the same
template in another rotation. Two secrets give two lifts, which come near each other in the
embedding: what two tenants, or two names, have of a person who keeps a key and gave both the same
photos. Photos that overlap those of an earlier enrollment give two lifts of nearly one embedding,
and different photos come near each other in the person. A thief without the holder's key opens
none of them.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.holder_keys import KEPT, STOLEN, THEFTS, Guess, Theft
from attacks.outcomes import AttackOutcome, Knowledge, judged_by_controls
from attacks.population import Subjects
from attacks.recovery import recovery_outcome
from attacks.system import System
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

COUNTS = (2, 5)
"""T: numbers of templates of different photos."""
TWO_SECRETS = "the same photos under two lift secrets"
OVERLAP = "two of three photos the same"
OVERLAPPING = ((0, 1, 2), (0, 1, 3))
"""Photos of two enrollments that overlap."""
JUDGED_PEOPLE = 75
"""Of fewer people a share says too little to judge by: of none of 74 the upper bound is 4 %, twice
the limit where keys are kept."""
_SHARED = 1e-3
"""A direction that all of T templates have is one in which Σ dist² rises by less than this · T:
the rounding of the wire format makes it 10⁻⁶, and two directions of different decoys make it 0.2
and more."""
_ROUNDS = 100

Array = NDArray[np.float64]


def several_templates(
    system: System, photos: Sequence[NDArray[np.float32]], guess: Guess
) -> list[AttackOutcome]:
    """Steal several templates of each person, with the holder's key and without it.

    Parameters
    ----------
    photos
        Of every person (i, n) unit rows, embeddings. The last is the fresh photo; of the others, T
        are lifted, one template each. People with fewer are left out, and T that nobody reaches; T
        that fewer than 75 people reach is reported, and not judged.

    Returns
    -------
    list of AttackOutcome
        Named ``several-templates``: for each the mean of the guesses from all, and the point that
        is nearest to all; with the key kept judged where the same guess succeeds with the key.
    """
    outcomes: list[AttackOutcome] = []
    twice = [
        system.lift(system.victims.enrolled, f"victims under {name} secret")
        for name in ("one", "another")
    ]
    outcomes += _guessed(system, twice, guess, TWO_SECRETS, system.victims)
    most = max(map(max, OVERLAPPING)) + 1
    enough = [album for album in photos if len(album) > most]
    if enough:
        batches = [
            system.lift(_means(system, enough, numbers), f"{OVERLAP}, photos {numbers}")
            for numbers in OVERLAPPING
        ]
        outcomes += _guessed(system, batches, guess, OVERLAP, _people(system, enough, most))
    for count in COUNTS:
        enough = [album for album in photos if len(album) > count]
        if enough:
            batches = [
                system.lift(_means(system, enough, [number]), f"photo {number} of {count}")
                for number in range(count)
            ]
            people = _people(system, enough, count)
            outcomes += _guessed(system, batches, guess, "different photos", people)
    return judged_by_controls(outcomes, KEPT, STOLEN)


def _means(
    system: System, albums: Sequence[NDArray[np.float32]], numbers: Sequence[int]
) -> NDArray[np.float32]:
    """What some photos of every person enroll, (V, k): averaged, then projected."""
    means = [album[list(numbers)].mean(axis=0, dtype=np.float64) for album in albums]
    return system.source.project(normalised(np.stack(means)).astype(np.float32))


def _people(system: System, albums: Sequence[NDArray[np.float32]], count: int) -> Subjects:
    """The people of some albums, whose last photo is the fresh one."""
    return Subjects(
        enrolled=_means(system, albums, range(count)),
        fresh=system.source.project(np.stack([album[-1] for album in albums])),
        photos=np.full(len(albums), 1),
        shown=np.full(len(albums), -1),  # of no folder
    )


def _guessed(
    system: System, batches: Sequence[SubspaceBatch], guess: Guess, photos: str, people: Subjects
) -> Iterator[AttackOutcome]:
    """Guess from T templates of each of V people, ``batches``: T of V templates."""
    for theft in THEFTS:
        yield from _of_theft(system, batches, guess, photos, people, theft)


def _of_theft(
    system: System,
    batches: Sequence[SubspaceBatch],
    guess: Guess,
    photos: str,
    people: Subjects,
    theft: Theft,
) -> Iterator[AttackOutcome]:
    count = len(batches)
    seen = [
        theft.of(system, batch, f"{photos}, enrollment {number}")
        for number, batch in enumerate(batches)
    ]
    guesses = {
        "mean of the likeliest": normalised(np.sum([guess(batch) for batch in seen], axis=0)),
        "nearest to all": nearest_common_points(seen),
    }
    few = len(people) < JUDGED_PEOPLE
    for name, points in guesses.items():
        yield recovery_outcome(
            system,
            points,
            attack="several-templates",
            variant=f"{photos}, {count} templates, {name}, {theft.variant}",
            leaked=theft.leaked,
            knowledge=Knowledge.TEMPLATES,
            assumption=f"{theft.assumption}: {count} templates of each person, of {photos}; "
            "success is a match of the guess with a photo of none of them",
            unjudged=f"fewer than {JUDGED_PEOPLE} people have the photos" if few else None,
            people=None if people is system.victims else people,
            details={"templates": count, "people": len(people)},
        )


def meeting_point(feet: Array, bases: Array) -> Array:
    """Find the point of least Σ dist² to T affine subspaces; of several, the one of least norm.

    Parameters
    ----------
    feet : (T, k)
    bases : (T, m, k)
        Orthonormal, orthogonal to their foot points.

    Notes
    -----
    The normal equations are (T I - BᵀB) x = Σ p_t with the bases stacked in B; where T - σ² is 0
    for an eigenvalue σ² of BᵀB, the component along its eigenvector is removed.
    """
    count = len(feet)
    rows = bases.reshape(-1, bases.shape[2])
    squares, vectors = np.linalg.eigh(rows.T @ rows)
    curvature = count - squares
    free = curvature < _SHARED * count
    inverse = np.where(free, 0.0, 1.0 / np.where(free, 1.0, curvature))
    return np.asarray(vectors @ (inverse * (vectors.T @ feet.sum(axis=0))))


def nearest_common_point(feet: Array, bases: Array, starts: Array) -> Array:
    """Find the unit vector of largest Σ sim to T affine subspaces.

    Parameters
    ----------
    feet, bases
        As in ``meeting_point``.
    starts : (S, k)
        Where to start from; the best end is returned.

    Notes
    -----
    sim_t(x) = p_t·x + s_t ‖D_t x‖ is the largest cosine to a unit vector y_t of the subspace, and
    x ← normalise(Σ y_t) raises Σ sim_t in every round.
    """
    radii = np.sqrt(np.maximum(1 - np.einsum("ti,ti->t", feet, feet), 0))
    rows = bases.reshape(-1, bases.shape[2])
    total = feet.sum(axis=0)
    points = normalised(starts)
    for _ in range(_ROUNDS):
        inside = (points @ rows.T).reshape(len(points), len(feet), -1)
        inside *= (radii / np.maximum(np.linalg.norm(inside, axis=2), 1e-12))[:, :, None]
        following = normalised(total + inside.reshape(len(points), -1) @ rows)
        moved = float(np.abs(following - points).max())
        points = following
        if moved < 1e-7:
            break
    lengths = np.linalg.norm((points @ rows.T).reshape(len(points), len(feet), -1), axis=2)
    values = points @ total + lengths @ radii
    return np.asarray(points[int(np.argmax(values))])


def nearest_common_points(batches: Sequence[SubspaceBatch]) -> Array:
    """Find the ``nearest_common_point`` of template i of all batches, for every i, (V, k)."""
    points = []
    for row in range(len(batches[0])):
        feet = np.stack([batch.feet[row] for batch in batches]).astype(np.float64)
        bases = np.stack([batch.bases[row] for batch in batches]).astype(np.float64)
        starts = np.concatenate([meeting_point(feet, bases)[None], feet])
        points.append(nearest_common_point(feet, bases, starts))
    return np.stack(points)
