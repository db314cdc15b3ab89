"""Several photos of one person: how well they agree that they are, and the one mean of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from templates.errors import VeilfaceError

_LEAST_NORM = 1e-12
_LEAST_MEAN = 1e-6


class InconsistentImages(VeilfaceError):
    """The photos of one enrollment or probe do not all show the same person.

    Parameters
    ----------
    apart, others
        Positions from 0, ascending: the photos that differ from the others. Where both are as
        many, either may be the stranger's.
    """

    def __init__(self, apart: Sequence[int], others: Sequence[int]) -> None:
        self.apart = tuple(apart)
        self.others = tuple(others)
        super().__init__(self.sentence())

    @property
    def photos(self) -> tuple[int, ...]:
        """The photos that differ, ascending: all of them where either half may."""
        if len(self.apart) < len(self.others):
            return self.apart
        return tuple(sorted(self.apart + self.others))

    def sentence(self, names: Sequence[str] | None = None) -> str:
        """Say which photos differ: by their names, else by numbers from 1."""
        if len(self.apart) == len(self.others) == 1:
            differing = f"{_listed(self.photos, names)} do not look like the same person"
        else:
            verb = "does" if len(self.apart) == 1 else "do"
            differing = (
                f"{_listed(self.apart, names)} {verb} not look like the person on "
                f"{_listed(self.others, names)}"
            )
        return f"{differing}; send photos of one person only, or clearer ones"


def _listed(positions: Sequence[int], names: Sequence[str] | None) -> str:
    if names is not None:
        shown = [names[position] for position in positions]
    else:
        shown = [str(position + 1) for position in positions]
        shown[0] = f"{'photos' if len(shown) > 1 else 'photo'} {shown[0]}"
    return " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)


def distinct_rows(rows: NDArray[np.floating]) -> list[int]:
    """Return the positions of rows that repeat no earlier one, ascending, of (k, n)."""
    first: dict[bytes, int] = {}
    for place, row in enumerate(rows):
        first.setdefault(row.tobytes(), place)
    return list(first.values())


def mean_embedding(rows: NDArray[np.float32], *, consistency: float) -> NDArray[np.float32]:
    """Average the unit rows of one person and normalise, (k, n) to (n,).

    A row that comes again, as of a photo given twice, counts once.

    Raises
    ------
    InconsistentImages
        Where the rows part into two groups that agree less than ``consistency``
        (:func:`weakest_split`), or cancel.
    """
    places = distinct_rows(rows)
    mean = rows[places].astype(np.float64).mean(axis=0)
    norm = float(np.linalg.norm(mean))
    if len(places) > 1:
        split = weakest_split(rows[places])
        if split.agreement < consistency or norm < _LEAST_MEAN:
            raise InconsistentImages(
                [places[row] for row in split.apart], [places[row] for row in split.others]
            )
    return np.asarray(mean / norm, dtype=np.float32)


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
