"""Whether two templates of one person, of two tenants or of one, can be told from two people's.

Without a secret, templates link by what they are for (docs/method.md §4.9). A rotation of each,
drawn by the Haar measure, leaves of a template nothing but its foot point's length: two affine
subspaces of one dimension are images of each other under a rotation exactly if their feet are
equally long. So the lengths are all that an attacker without a tenant's key can compare. With the
key every rotation is derived, and undone.
"""

from collections.abc import Iterator

import numpy as np

from attacks.attack import LinkScores, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property


@attack(breaks=Property.UNLINKABILITY, needs=Knowledge(generator=True))
def foot_lengths(bed: Testbed) -> Iterator[LinkScores]:
    """The lengths of the foot points of two templates are compared: no rotation changes them."""
    left, right = bed.batches
    yield LinkScores(-np.abs(left.foot_norms[:, None] - right.foot_norms))
