"""How well several photos agree that they show one person, from their raw embeddings."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_LEAST_NORM = 1e-12


class WeakestSplit(NamedTuple):
    """The way to part a set of photos into two groups that speaks most for two people.

    Parameters
    ----------
    agreement
        How alike the two groups are, -1 to 1.
    apart
        Positions of the smaller group, ascending; of equal ones the one without the first photo.
    others
        The other positions, ascending.
    """

    agreement: float
    apart: tuple[int, ...]
    others: tuple[int, ...]


def weakest_split(embeddings: NDArray[np.floating]) -> WeakestSplit:
    """Find the split of 2 to 10 photos into two groups that agree least.

    Parameters
    ----------
    embeddings : (k, n) floating
        Unit rows.

    Notes
    -----
    One photo agrees with the others by its cosine to their mean, which is less noisy than the
    cosine to each of them. Larger groups agree by the mean cosine across: the cosine of their means
    would grow with their size for strangers too. Each photo against the mean of the others alone
    does not do: two photos of one person and two of another pass it, as each has a companion
    (docs/thresholds.md "Photos of one person").
    """
    rows = np.asarray(embeddings, dtype=np.float64)
    count = len(rows)
    if count < 2:
        raise ValueError("one photo agrees with itself: a split needs two")
    cosines = rows @ rows.T
    # The first photo is on the side of zeros, so that every split occurs once.
    numbers = np.arange(1, 2 ** (count - 1))
    sides = np.zeros((len(numbers), count))
    sides[:, 1:] = numbers[:, None] >> np.arange(count - 1) & 1
    rest = 1.0 - sides
    across = np.einsum("si,ij,sj->s", sides, cosines, rest)
    sizes = sides.sum(axis=1)
    within = np.stack([np.einsum("si,ij,sj->s", one, cosines, one) for one in (sides, rest)])
    agreement = across / (sizes * (count - sizes))
    single = np.minimum(sizes, count - sizes) == 1
    norms = np.sqrt(np.maximum(within.prod(axis=0), _LEAST_NORM))
    agreement[single] = across[single] / norms[single]
    worst = int(np.argmin(agreement))
    groups = (np.flatnonzero(sides[worst]), np.flatnonzero(rest[worst]))
    apart, others = sorted(groups, key=len)  # stable: of equal ones, the side of ones first
    return WeakestSplit(float(agreement[worst]), tuple(apart.tolist()), tuple(others.tolist()))
