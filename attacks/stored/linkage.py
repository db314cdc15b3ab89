"""Whether two templates of one person, of two tenants or of one, can be told from two people's.

Without a secret, templates link by what they are for (docs/method.md §4.9). A rotation of each,
drawn by the Haar measure, leaves of a template nothing but its foot point's length: two affine
subspaces of one dimension are images of each other under a rotation exactly if their feet are
equally long. So the lengths are all that an attacker without a tenant's key can compare. With the
key every rotation is derived, and undone.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from attacks.runner import LinkScores, attack
from attacks.second_order import Moments
from templates.space.subspace import SubspaceBatch

Array64 = NDArray[np.float64]


@attack(breaks=Property.UNLINKABILITY, needs=Knowledge(generator=True))
def foot_lengths(bed: Testbed) -> Iterator[LinkScores]:
    """The lengths of the foot points of two templates are compared: no rotation changes them."""
    left, right = bed.batches
    yield LinkScores(-np.abs(left.foot_norms[:, None] - right.foot_norms))


@attack(breaks=Property.UNLINKABILITY, needs=Knowledge(generator=True, unrotated=True))
def span_overlap(bed: Testbed) -> Iterator[LinkScores]:
    """The spans of two templates are compared, by how much more they share than decoys explain."""
    left, right = bed.batches
    yield LinkScores(span_overlaps(left, right, bed.decoys))


def span_overlaps(left: SubspaceBatch, right: SubspaceBatch, decoys: Moments) -> Array64:
    """How much the linear spans of templates have in common, (T, U): more where they share a face.

    The sum of squared cosines of the principal angles, in coordinates in which decoys are spread
    evenly, less the average over templates. Nearest points tell nothing where two templates have
    more dimensions than the axes are: they meet then, whosesoever they are.
    """
    white = decoys.whitening.astype(np.float64)

    def projectors(batch: SubspaceBatch) -> Array64:
        rows = []
        for foot, basis in zip(batch.feet, batch.bases, strict=True):
            span = np.concatenate([foot[None], basis]).astype(np.float64) @ white
            axes = np.linalg.qr(span.T)[0]
            rows.append((axes @ axes.T).ravel())
        return np.asarray(np.stack(rows) - np.mean(rows, axis=0))

    return np.asarray(projectors(left) @ projectors(right).T)
