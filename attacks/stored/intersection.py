"""Intersection: lifts of one descriptor with different decoys meet in it (docs/method.md §4.6).

Templates of different photos of one person do not meet, but come near each other in the person:
``attacks.several_templates``.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import AttackOutcome, Knowledge
from attacks.recovery import recovery_outcome
from attacks.system import System
from templates.decoys import Attributes
from templates.keys.randomness import Keystream
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

Array = NDArray[np.float64]

LIFTS = (2, 5)
_SHARED = 1e-3
"""A direction that all of T templates have is one in which Σ dist² rises by less than this · T:
the rounding of the wire format makes it 10⁻⁶, and two directions of different decoys make it 0.2
and more."""
_ROUNDS = 100


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
    The normal equations are (T I - BᵀB) x = Σ p_t with the bases stacked in B, of Tm rows; where
    T - σ² is 0 for an eigenvalue σ² of BᵀB, the component along its eigenvector is removed. BBᵀ has
    the same eigenvalues, and is factorised where it is the smaller one: with BBᵀ = U Σ² Uᵀ the
    solution is (b + BᵀU (T - Σ²)⁻¹ UᵀB b) / T.
    """
    count = len(feet)
    total = feet.sum(axis=0)
    rows = bases.reshape(-1, bases.shape[2])
    small = len(rows) < rows.shape[1]
    squares, vectors = np.linalg.eigh(rows @ rows.T if small else rows.T @ rows)
    curvature = count - squares
    free = curvature < _SHARED * count
    inverse = 1.0 / np.where(free, 1.0, curvature)
    if small:
        weights = np.where(free, -1.0 / count, inverse)
        point = (total + rows.T @ (vectors @ (weights * (vectors.T @ (rows @ total))))) / count
    else:
        point = vectors @ (np.where(free, 0.0, inverse) * (vectors.T @ total))
    return Meeting(point, int(free.sum()))


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
    """Find the ``nearest_common_point`` of template i of all batches, for every i, (V, n)."""
    points = []
    for feet, bases in _stacked(batches):
        starts = np.concatenate([meeting_point(feet, bases).point[None], feet])
        points.append(nearest_common_point(feet, bases, starts))
    return np.stack(points)


def same_descriptor(system: System, *, lifts: Sequence[int] = LIFTS) -> list[AttackOutcome]:
    """Intersect T templates of one descriptor: as they are lifted, and through the wire format."""
    outcomes = []
    for stored in (True, False):
        batches = [
            system.lift(system.victims.enrolled, f"lift {number} of one descriptor")
            if stored
            else in_memory(system, f"lift {number} of one descriptor")
            for number in range(max(lifts))
        ]
        for count in lifts:
            meetings = [meeting_point(*stacked) for stacked in _stacked(batches[:count])]
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
                        "victim."
                    ),
                    unjudged="the service draws the same decoys for the same photos; clients that "
                    "lift may not",
                    details={
                        "lifts": count,
                        "templates_that_share_a_decoy": int(np.count_nonzero(~unique)),
                        "largest_error_where_unique": float(gaps.max()) if gaps.size else None,
                    },
                )
            )
    return outcomes


def in_memory(system: System, purpose: str) -> SubspaceBatch:
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


def _stacked(batches: Sequence[SubspaceBatch]) -> Iterator[tuple[Array, Array]]:
    """Yield foot points (T, n) and bases (T, m, n) of every row's T templates."""
    for row in range(len(batches[0])):
        yield (
            np.stack([batch.feet[row] for batch in batches]).astype(np.float64),
            np.stack([batch.bases[row] for batch in batches]).astype(np.float64),
        )
