"""What an attacker infers who holds the decoy pool (docs/method.md §4.2 and §4.5)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.neighbours import nearest_neighbours
from templates.distances import Metric
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Codes = NDArray[np.int64]
Flags = NDArray[np.bool_]

TOUCH = 0.01
"""An entry nearer than this lies in the template: its decoys are at 1e-3 or less even in half
precision, and the next entry is 0.8 away (docs/method.md §4.2)."""


@dataclass(frozen=True, eq=False, repr=False)
class Decoys:
    """Which entries of the pool lie in which template.

    Parameters
    ----------
    entries : (P, k) int64
        Positions in the pool.
    found : (P, k) bool
        Which of them are there; the others are padding.
    """

    entries: Codes
    found: Flags


def find_decoys(
    templates: SubspaceBatch,
    pool: Array32,
    *,
    most: int,
    skip: Codes | None = None,
) -> Decoys:
    """Find the entries of the pool that lie in each template.

    Parameters
    ----------
    pool : (W, n) float32
    most
        At most so many: the decoys that the strategy takes.
    skip : (P,) int64, optional
        Entry that is the face itself, where the attacker lifted entries of its own pool.
    """
    nearest = nearest_neighbours(
        templates,
        pool,
        k=min(most, len(pool) - (skip is not None)),
        metrics=(Metric.EUCLIDEAN,),
        skip=skip,
    )[Metric.EUCLIDEAN]
    return Decoys(nearest.indices, nearest.distances < TOUCH)


def strip(templates: SubspaceBatch, pool: Array32, decoys: Decoys) -> Array32:
    """Remove the known decoys from the templates' foot points.

    The foot point is an affine combination of the descriptor, the decoys and random directions;
    what is left of it outside the decoys' span points along the descriptor's own part there.

    Returns
    -------
    float32, shape (P, n)
        Unit rows, close to the descriptors in direction; the foot point's direction where no decoy
        is known.
    """
    spans = pool[decoys.entries].astype(np.float64) * decoys.found[:, :, None]
    left, singular, _ = np.linalg.svd(spans.transpose(0, 2, 1), full_matrices=False)
    left = left * (singular > 1e-6)[:, None, :]
    feet = templates.feet.astype(np.float64)
    for _ in range(2):  # once more removes what rounding left
        feet -= (left @ (left.transpose(0, 2, 1) @ feet[:, :, None]))[:, :, 0]
    return normalised(feet).astype(np.float32)
