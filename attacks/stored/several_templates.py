"""Several templates of one person: of the same photos, of some of them, and of others.

The service draws the decoys of the same photos under a secret: a new enrollment gives the same
template in another rotation. Two secrets give two lifts, which come near each other in the
embedding: what two tenants, or two names, have of a person who keeps a key and gave both the same
photos. Photos that overlap those of an earlier enrollment give two lifts of nearly one embedding,
and different photos come near each other in the person. A thief without the holder's key opens
none of them.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Guesses, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from attacks.stored.second_moments import likeliest
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

_SHARED = 1e-3
"""A direction that all of T templates have is one in which Σ dist² rises by less than this · T:
the rounding of the wire format makes it 10⁻⁶, and two directions of different decoys make it 0.2
and more."""
_ROUNDS = 100
_SEVERAL = Knowledge(several=True, generator=True, faces=True)

Array = NDArray[np.float64]


@attack(breaks=Property.IRREVERSIBILITY, needs=_SEVERAL)
def mean_of_likeliest(bed: Testbed) -> Iterator[Guesses]:
    """The mean of the points that are likeliest the face, of several templates of one person."""
    yield Guesses(normalised(np.sum([likeliest(bed, batch) for batch in bed.batches], axis=0)))


@attack(breaks=Property.IRREVERSIBILITY, needs=_SEVERAL)
def nearest_to_all(bed: Testbed) -> Iterator[Guesses]:
    """The unit vector that is nearest to several templates of one person."""
    yield Guesses(nearest_common_points(bed.batches))


def meeting_point(feet: Array, bases: Array) -> Array:
    """Find the point of least Σ dist² to T affine subspaces; of several, the one of least norm.

    Feet are (T, k); bases (T, m, k), orthonormal and orthogonal to their foot points.

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
    """Find the unit vector of largest Σ sim to T affine subspaces (as in ``meeting_point``).

    The search begins at each of ``starts``, (S, k); the best end is returned.

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
