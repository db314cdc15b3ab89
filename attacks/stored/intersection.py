"""Intersection: several templates of one descriptor meet in it (docs/method.md §4.6).

Templates of different photos of one person do not meet, but come near each other in the person.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import AttackOutcome, Knowledge
from attacks.population import Subjects
from attacks.recovery import recovery_outcome
from attacks.system import System
from templates.decoys import Attributes
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

Array = NDArray[np.float64]

LIFTS = (2, 3, 5, 10, 20)
_SHARED = 1e-3
"""A direction that all of T templates have is one in which Σ dist² rises by less than this · T:
the rounding of the wire format makes it 10⁻⁶, and two directions of different decoys make it 0.2
and more."""
_ROUNDS = 100
JUDGED_PEOPLE = 20
"""Of fewer people a share says too little to judge by."""


class Meeting(NamedTuple):
    """Where templates meet."""

    point: Array
    """(n,): the point of least Σ dist²; of several, the one of least norm."""
    shared: int
    """Number of directions that all templates have: where it is not 0, they meet in more points
    than one."""


def meeting_point(feet: Array, bases: Array) -> Meeting:
    """Find the point of least Σ dist² to T affine subspaces.

    Parameters
    ----------
    feet : (T, n)
    bases : (T, m, n)
        Orthonormal, orthogonal to their foot points.

    Notes
    -----
    The normal equations are (T I - BᵀB) x = Σ p_t with the bases stacked in B, of Tm rows. With
    BBᵀ = U Σ² Uᵀ their solution is (b + BᵀU (T - Σ²)⁻¹ UᵀB b) / T, which takes a factorisation of
    Tm rows and columns instead of n. Where T - Σ² is 0, the component along Bᵀu is removed.
    """
    count = len(feet)
    total = feet.sum(axis=0)
    rows = bases.reshape(-1, bases.shape[2])
    squares, vectors = np.linalg.eigh(rows @ rows.T)
    curvature = count - squares
    free = curvature < _SHARED * count
    weights = np.where(free, -1.0 / count, 1.0 / np.where(free, 1.0, curvature))
    along = vectors.T @ (rows @ total)
    return Meeting((total + rows.T @ (vectors @ (weights * along))) / count, int(free.sum()))


def nearest_common_point(feet: Array, bases: Array, starts: Array) -> Array:
    """Find the unit vector of largest Σ sim to T affine subspaces.

    Parameters
    ----------
    feet, bases
        As in ``meeting_point``.
    starts : (S, n)
        Where to start from; the best end is returned.

    Notes
    -----
    sim_t(x) = p_t·x + s_t ‖D_t x‖ is the largest cosine to a unit vector y_t of the subspace, and
    x ← normalise(Σ y_t) raises Σ sim_t in every round.
    """
    radii = np.sqrt(np.maximum(1 - np.einsum("ti,ti->t", feet, feet), 0))
    rows = bases.reshape(-1, bases.shape[2])
    total = feet.sum(axis=0)
    points = _normalised(starts)
    for _ in range(_ROUNDS):
        inside = (points @ rows.T).reshape(len(points), len(feet), -1)
        inside *= (radii / np.maximum(np.linalg.norm(inside, axis=2), 1e-12))[:, :, None]
        following = _normalised(total + inside.reshape(len(points), -1) @ rows)
        moved = float(np.abs(following - points).max())
        points = following
        if moved < 1e-7:
            break
    lengths = np.linalg.norm((points @ rows.T).reshape(len(points), len(feet), -1), axis=2)
    values = points @ total + lengths @ radii
    return np.asarray(points[int(np.argmax(values))])


def nearest_common_points(batches: Sequence[SubspaceBatch]) -> Array:
    """Find the ``nearest_common_point`` of template i of all batches, for every i, (V, n)."""
    points = []
    for feet, bases in _stacked(batches):
        starts = np.concatenate([meeting_point(feet, bases).point[None], feet])
        points.append(nearest_common_point(feet, bases, starts))
    return np.stack(points)


def _normalised(rows: Array) -> Array:
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12))


def same_descriptor(system: System, *, lifts: Sequence[int] = LIFTS) -> list[AttackOutcome]:
    """Intersect T templates of one descriptor: as they are lifted, and through the wire format."""
    outcomes = []
    for stored in (True, False):
        batches = [
            system.lift(system.victims.enrolled, f"lift {number} of one descriptor")
            if stored
            else _in_memory(system, f"lift {number} of one descriptor")
            for number in range(max(lifts))
        ]
        for count in lifts:
            meetings = _meetings(batches[:count])
            unique = np.array([meeting.shared == 0 for meeting in meetings])
            guesses = np.stack([meeting.point for meeting in meetings])
            gaps = np.linalg.norm(guesses - system.victims.enrolled, axis=1)[unique]
            form = "float16 of the wire format" if stored else "float32"
            outcomes.append(
                recovery_outcome(
                    system,
                    guesses,
                    attack="intersection",
                    variant=f"{count} lifts of one embedding, {form}",
                    knowledge=Knowledge.TEMPLATES,
                    assumption=(
                        f"The attacker has {count} templates of one embedding ({form}) and takes "
                        "the point where they meet; success is a match with a fresh photo of the "
                        "victim. Not judged: the service lifts an embedding once."
                    ),
                    judged=False,
                    details={
                        "lifts": count,
                        "templates_that_share_a_decoy": int(np.count_nonzero(~unique)),
                        "largest_error_where_unique": float(gaps.max()) if gaps.size else None,
                    },
                )
            )
    return outcomes


def different_photos(
    system: System, photos: Sequence[NDArray[np.float32]], *, lifts: Sequence[int] = LIFTS
) -> list[AttackOutcome]:
    """Intersect templates of different photos of one person.

    Parameters
    ----------
    photos
        Of every person (k_i, n) unit rows. The last is the fresh photo; of the others, T are
        lifted, one template each. People with fewer are left out, and T that nobody reaches; T
        that fewer than 20 people reach is reported, and not judged.
    """
    outcomes = []
    for count in lifts:
        enough = [album for album in photos if len(album) > count]
        if not enough:
            continue
        batches = [
            system.lift(np.stack([album[number] for album in enough]), f"photo {number} of {count}")
            for number in range(count)
        ]
        means = np.stack([album[:count].mean(axis=0, dtype=np.float64) for album in enough])
        people = Subjects(
            enrolled=_normalised(means).astype(np.float32),
            fresh=np.stack([album[-1] for album in enough]),
            photos=np.full(len(enough), count),
            shown=np.full(len(enough), -1),  # of no folder
        )
        plain = np.stack([meeting.point for meeting in _meetings(batches)])
        guesses = nearest_common_points(batches)
        outcomes.append(
            recovery_outcome(
                system,
                guesses,
                attack="intersection",
                variant=f"{count} photos of one person",
                knowledge=Knowledge.TEMPLATES,
                assumption=(
                    f"The attacker has {count} templates of one person, each of another photo and "
                    "without its rotation, and takes the point that is nearest to all; success is "
                    "a match with a further photo. The truth is the mean of the lifted photos."
                    + (
                        ""
                        if len(enough) >= JUDGED_PEOPLE
                        else f" Not judged: fewer than {JUDGED_PEOPLE} people have the photos."
                    )
                ),
                judged=len(enough) >= JUDGED_PEOPLE,
                people=people,
                details={
                    "photos": count,
                    "people": len(enough),
                    "cosine_of_plain_least_squares_mean": float(
                        np.einsum("ij,ij->i", _normalised(plain), people.enrolled).mean()
                    ),
                },
            )
        )
    return outcomes


def _in_memory(system: System, purpose: str) -> SubspaceBatch:
    """Lift the victims without the rounding of the wire format."""
    strategy = system.lifter.strategy
    named = [Attributes()] * len(system.victims) if strategy is Strategy.HYBRID_PLUS else None
    with Keystream.seeded("audit", system.seed, str(system.scheme), purpose) as stream:
        return lift(
            system.victims.enrolled,
            strategy=strategy,
            m=system.scheme.dim,
            source=system.lifter.source,
            stream=stream,
            attributes=named,
        )


def _stacked(batches: Sequence[SubspaceBatch]) -> list[tuple[Array, Array]]:
    """Foot points (T, n) and bases (T, m, n) of every row's T templates."""
    return [
        (
            np.stack([batch.feet[row] for batch in batches]).astype(np.float64),
            np.stack([batch.bases[row] for batch in batches]).astype(np.float64),
        )
        for row in range(len(batches[0]))
    ]


def _meetings(batches: Sequence[SubspaceBatch]) -> list[Meeting]:
    return [meeting_point(feet, bases) for feet, bases in _stacked(batches)]
