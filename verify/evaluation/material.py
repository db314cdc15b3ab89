"""What an evaluation computes on: descriptors, pairs and decoys."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.decoys import Attributes, DecoyGenerator, DecoyPool

Source = DecoyPool | DecoyGenerator


@dataclass(frozen=True, eq=False, repr=False)
class Material:
    """Everything that scores depend on, besides a unit.

    Parameters
    ----------
    descriptors : (N, n) float32
        Unit rows of the photos that were acquired.
    flipped : (N, n) float32, optional
        The same with the mirror image added.
    first, second : (P,) int64
        Pairs of rows.
    same : (P,) bool
    folds : (P,) int64
    people : (2, P) int64, optional
        People on the first and on the second photo of each pair, where the set names people.
    attributes
        One per row, where hybrid+ is evaluated.
    sources
        Decoy sources, from which people of the set were removed.
    """

    descriptors: NDArray[np.float32]
    flipped: NDArray[np.float32] | None
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    same: NDArray[np.bool_]
    folds: NDArray[np.int64]
    people: NDArray[np.int64] | None
    attributes: Sequence[Attributes] | None
    sources: tuple[Source, ...]

    def __len__(self) -> int:
        return len(self.same)

    @property
    def n(self) -> int:
        """Dimension of the descriptors."""
        return int(self.descriptors.shape[1])
