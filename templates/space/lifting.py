"""From descriptors to private templates: the strategies of paper §3.2, §4.2 and §4.3."""

import hashlib
import hmac
from collections.abc import Sequence
from enum import StrEnum
from typing import assert_never

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.decoys.source import Attributes, DecoySource
from templates.errors import LiftingError
from templates.keys.randomness import Keystream
from templates.keys.sealing import encode_parts
from templates.space.embedding import unit_descriptors
from templates.space.subspace import SubspaceBatch

SUB_DATABASES = 16
"""Parts that the sub-strategies split the database into (paper §4.2)."""

# Two decoys, or a decoy and the descriptor, nearer than this are one photo twice: they would add
# a direction of noise. Real descriptors of different photos are 0.1 apart or more.
_SAME = 1e-3
_REDRAWS = 16
_TILE_BYTES = 64 << 20


class Strategy(StrEnum):
    """How the directions of a subspace are chosen (docs/method.md §2.1)."""

    RANDOM = "random"
    ADVERSARIAL = "adversarial"
    HYBRID = "hybrid"
    HYBRID_PLUS = "hybrid+"
    SUB_ADVERSARIAL = "sub-adversarial"
    SUB_HYBRID = "sub-hybrid"

    @property
    def needs_decoys(self) -> bool:
        """Whether directions lead to decoys, which a source has to give."""
        return self is not Strategy.RANDOM

    def decoys(self, m: int) -> int:
        """Number of decoys among ``m`` directions: all, half (rounded down) or none."""
        match self:
            case Strategy.RANDOM:
                return 0
            case Strategy.ADVERSARIAL | Strategy.SUB_ADVERSARIAL:
                return m
            case Strategy.HYBRID | Strategy.HYBRID_PLUS | Strategy.SUB_HYBRID:
                return m // 2
            case _:
                assert_never(self)

    @property
    def sub_databases(self) -> int | None:
        """Number of sub-databases to draw from, or None for the whole database."""
        split = self in (Strategy.SUB_ADVERSARIAL, Strategy.SUB_HYBRID)
        return SUB_DATABASES if split else None


# A pool may own a real person whom templates of nobody must not hold, so these are lifted from
# generated descriptors with generated decoys; such strategies are then their plain forms.
_PLAIN = {
    Strategy.HYBRID_PLUS: Strategy.HYBRID,
    Strategy.SUB_HYBRID: Strategy.HYBRID,
    Strategy.SUB_ADVERSARIAL: Strategy.ADVERSARIAL,
}


def plain_strategy(strategy: Strategy) -> Strategy:
    """Return the form of a strategy that needs no labels and no sub-databases."""
    return _PLAIN.get(strategy, strategy)


def lift_stream(
    secret: bytes,
    *,
    contract_id: str,
    photos: Sequence[bytes],
    holder: tuple[str, str] | None = None,
) -> Keystream:
    """Return the stream that one set of photos is lifted from: the same whenever they come again.

    Two lifts of one descriptor with different decoys meet in it (docs/method.md §4.6). From this
    stream they are one set, which tells no more than either.

    Parameters
    ----------
    secret : bytes
        32 random bytes of the deployment. With these very pixels they give the decoys.
    photos : sequence of bytes
        What was sent, in any order, however often each: digests of the decoded photos, or the bytes
        of embeddings. Not what a model made of photos, which another processor rounds otherwise.
    holder : (tenant, subject), optional
        Whose key turns the template. Nobody sees two such templates meet without the keys, and one
        set would show, by the length of its foot point, that two enrollments are of the same photos
        (docs/privacy.md "Attacker by attacker"). So tenant and subject tell the streams apart.
    """
    digests = sorted({hashlib.sha256(photo).digest() for photo in photos})
    whose = ["lift"] if holder is None else ["lift for a holder", *holder]
    parts = encode_parts(*whose, contract_id, *digests)
    return Keystream(hmac.digest(secret, parts, hashlib.sha256))


def lift(
    descriptors: ArrayLike,
    *,
    strategy: Strategy | str,
    m: int,
    source: DecoySource | None = None,
    stream: Keystream | None = None,
    attributes: Sequence[Attributes] | None = None,
) -> SubspaceBatch:
    """Lift descriptors to private templates.

    Parameters
    ----------
    descriptors : array_like, shape (N, n)
        Unit rows (tolerance 1e-3). A person's photos are averaged first and lifted once: two
        lifts of one descriptor meet in it (docs/method.md §4.6).
    strategy : Strategy
    m : int
        Subspace dimension, 1 ≤ m < n; 2 or more for the hybrid strategies.
    source : DecoySource, optional
        Required by every strategy but random.
    stream : Keystream, optional
        Of :func:`lift_stream` for what is stored; a seeded one in experiments. A fresh one by
        default.
    attributes : sequence of Attributes, optional
        One per descriptor; required by hybrid+ and refused by the others.

    Returns
    -------
    SubspaceBatch
        Functions of the sets and of the stream only (see ``SubspaceBatch.through``).

    Raises
    ------
    InvalidEmbedding
        A descriptor is not a finite unit vector.
    LiftingError
        The request cannot be met.
    DecoyError
        The source lacks what the strategy needs.
    """
    points = unit_descriptors(descriptors)
    strategy = _check(points, strategy, m, source, attributes)
    count, n = points.shape
    stream = stream or Keystream.fresh()
    feet = np.empty((count, n), dtype=np.float32)
    bases = np.empty((count, m, n), dtype=np.float32)
    step = max(1, _TILE_BYTES // (8 * m * n))
    for first in range(0, count, step):
        tile = slice(first, min(first + step, count))
        chosen = None if attributes is None else attributes[tile]
        directions = _directions(points[tile], strategy, m, source, stream, chosen)
        batch = SubspaceBatch.through(points[tile], directions, stream=stream)
        feet[tile], bases[tile] = batch.feet, batch.bases
    return SubspaceBatch(feet, bases)


def _check(
    points: NDArray[np.float64],
    strategy: Strategy | str,
    m: int,
    source: DecoySource | None,
    attributes: Sequence[Attributes] | None,
) -> Strategy:
    """Check the request before anything is drawn or allocated."""
    count, n = points.shape
    try:
        strategy = Strategy(strategy)
    except ValueError:
        names = ", ".join(Strategy)
        raise LiftingError(f"unknown lifting strategy; choose one of {names}") from None
    if not 1 <= m < n:
        raise LiftingError(f"m = {m} is out of range: 1 <= m < n = {n}")
    if strategy.needs_decoys:
        if strategy.decoys(m) == 0:
            raise LiftingError(f"{strategy} lifting with m = {m} has no decoy: use m >= 2")
        if source is None:
            raise LiftingError(f"{strategy} lifting needs a decoy source")
        if source.k != n:
            raise LiftingError(f"decoys of {source.k} numbers do not fit embeddings of {n}")
    if strategy is Strategy.HYBRID_PLUS:
        if attributes is None or len(attributes) != count:
            raise LiftingError("hybrid+ lifting needs the attributes of every embedding")
    elif attributes is not None:
        raise LiftingError(f"{strategy} lifting does not use attributes: leave them out")
    return strategy


def _directions(
    points: NDArray[np.float64],
    strategy: Strategy,
    m: int,
    source: DecoySource | None,
    stream: Keystream,
    attributes: Sequence[Attributes] | None,
) -> NDArray[np.float64]:
    count, n = points.shape
    k = strategy.decoys(m)
    directions = np.empty((count, m, n))
    if k and source is not None:
        unlike = attributes if strategy is Strategy.HYBRID_PLUS else None
        directions[:, :k] = _decoys(points, k, source, stream, unlike, strategy.sub_databases)
        directions[:, :k] -= points[:, None]
    if k < m:
        directions[:, k:] = stream.uniform((count, m - k, n), -1.0, 1.0)
    return directions


def _decoys(
    points: NDArray[np.float64],
    k: int,
    source: DecoySource,
    stream: Keystream,
    unlike: Sequence[Attributes] | None,
    sub_databases: int | None,
) -> NDArray[np.float32]:
    """Draw decoys, and draw again where one photo came twice or is the subject's own."""
    decoys = source.draw(len(points), k, stream=stream, unlike=unlike, sub_databases=sub_databases)
    repeated = np.flatnonzero(_repeats(points, decoys))
    if repeated.size:
        decoys = decoys.copy()  # the array is the source's
    for _ in range(_REDRAWS):
        if not repeated.size:
            return decoys
        again = None if unlike is None else [unlike[row] for row in repeated.tolist()]
        decoys[repeated] = source.draw(
            len(repeated), k, stream=stream, unlike=again, sub_databases=sub_databases
        )
        repeated = repeated[_repeats(points[repeated], decoys[repeated])]
    raise LiftingError(
        "the decoy source keeps drawing the same photo twice, or the subject's own: "
        "remove duplicates from it, or ask for fewer decoys"
    )


def _repeats(points: NDArray[np.float64], decoys: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Rows in which two of the decoys and the descriptor nearly coincide, shape (N,)."""
    count, k, _ = decoys.shape
    if k == 0:
        return np.zeros(count, dtype=np.bool_)
    members = np.concatenate([points[:, None], decoys], axis=1)
    cosines = members @ members.transpose(0, 2, 1)
    cosines[:, np.arange(k + 1), np.arange(k + 1)] = -1
    return np.asarray((2 - 2 * cosines).min(axis=(1, 2)) < _SAME**2)
