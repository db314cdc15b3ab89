"""A pool of real decoys: the attacker who holds it, and the people who are in it.

See docs/method.md §4.2 and §4.3. A decoy lies in the subspace, at distance 0, and no other face
does.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Guesses, Probes, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from templates.distances import Metric, nearest
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

TOUCH = 0.01
"""An entry nearer than this lies in the template: its decoys are at 1e-3 or less even in half
precision, and the next entry is 0.8 away."""


class Decoys(NamedTuple):
    """Positions in the pool, (P, k) int64; and which are in the template, (P, k) bool."""

    entries: NDArray[np.int64]
    inside: NDArray[np.bool_]


def find_decoys(
    templates: SubspaceBatch,
    pool: NDArray[np.float32],
    *,
    most: int,
    own: NDArray[np.int64] | None = None,
) -> Decoys:
    """Find the entries of a pool (W, k) that lie in each template.

    Parameters
    ----------
    most
        At most so many: the decoys that the strategy takes.
    own : (P,) int64, optional
        Entry that is the face itself, where the attacker lifted entries of its own pool.
    """
    count = min(most + (own is not None), len(pool))
    entries, distances = nearest(pool, templates, k=count, metric=Metric.EUCLIDEAN)
    inside = distances < TOUCH
    if own is not None:
        inside &= entries != own[:, None]
    return Decoys(entries, inside)


def strip(
    templates: SubspaceBatch, pool: NDArray[np.float32], decoys: Decoys
) -> NDArray[np.float32]:
    """Remove the known decoys from the templates' foot points; unit rows (P, k).

    The foot point is an affine combination of the embedding, the decoys and random directions;
    what is left of it outside the decoys' span points along the embedding's own part there. Where
    no decoy is known that is the foot point's direction.
    """
    spans = pool[decoys.entries].astype(np.float64) * decoys.inside[:, :, None]
    left, singular, _ = np.linalg.svd(spans.transpose(0, 2, 1), full_matrices=False)
    left = left * (singular > 1e-6)[:, None, :]
    feet = templates.feet.astype(np.float64)
    for _ in range(2):  # once more removes what rounding left
        feet -= (left @ (left.transpose(0, 2, 1) @ feet[:, :, None]))[:, :, 0]
    return normalised(feet).astype(np.float32)


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge(pool=True))
def known_pool(bed: Testbed) -> Iterator[Guesses]:
    """What is left of the foot point outside the span of the pool's entries in the template."""
    if bed.pool is None:
        return
    entries = bed.pool.entries[0]
    decoys = find_decoys(bed.templates, entries, most=bed.strategy.decoys(bed.m))
    yield Guesses(
        strip(bed.templates, entries, decoys),
        details={
            "decoys_in_a_template": bed.strategy.decoys(bed.m),
            "decoys_found_mean": float(np.count_nonzero(decoys.inside, axis=1).mean()),
        },
    )


@attack(breaks=Property.IMPERSONATION, needs=Knowledge(template=False))
def pool_owner(bed: Testbed) -> Iterator[Probes]:
    """A new photo of a real person who is a decoy of the template; nothing needs to be stolen."""
    if bed.pool is None or bed.owners is None:
        return
    decoys = find_decoys(bed.templates, bed.pool.entries[0], most=1)
    yield Probes(np.ascontiguousarray(bed.owners.fresh[decoys.entries[:, 0]]))
