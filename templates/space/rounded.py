"""Templates with their bases rounded to eight bits, for sets that are read at every decision.

Each row of a basis keeps its largest number as 127 steps, so that a number is off by less than half
a step, 0.4 % of that row's largest. The rows of a template's basis are a random frame of its
directions, and their errors are independent: the similarity of a lifted probe moves by 3·10⁻⁴ (root
mean square, m = 192 and 4), a sixtieth of its spread. No stored template is ever rounded so.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from templates.space.subspace import SubspaceBatch, is_finite

_MOST = 127
_TINY = np.finfo(np.float32).tiny


@dataclass(frozen=True, eq=False, repr=False)
class RoundedBatch:
    """N templates of one dimension, in a quarter of a `SubspaceBatch`'s memory.

    Parameters
    ----------
    feet : ndarray of float32, shape (N, n)
    numbers : ndarray of int8, shape (N, m, n)
    steps : ndarray of float32, shape (N, m)
        The bases are ``steps[:, :, None] * numbers``.
    """

    feet: NDArray[np.float32]
    numbers: NDArray[np.int8]
    steps: NDArray[np.float32]

    @classmethod
    def of(cls, batch: SubspaceBatch) -> Self:
        """Round the bases of a batch; the foot points stay as they are."""
        numbers = np.empty(batch.bases.shape, dtype=np.int8)
        steps = np.empty(batch.bases.shape[:2], dtype=np.float32)
        for i, basis in enumerate(batch.bases):
            steps[i] = np.maximum(np.abs(basis).max(axis=1) / np.float32(_MOST), _TINY)
            numbers[i] = np.rint(basis / steps[i, :, None])
        return cls(batch.feet, numbers, steps)

    def __repr__(self) -> str:
        return f"RoundedBatch({len(self)} of n={self.n}, m={self.m})"

    def __len__(self) -> int:
        return int(self.feet.shape[0])

    def __getitem__(self, index: slice | NDArray[np.integer]) -> SubspaceBatch:
        """Return some of the templates in float32, as they were rounded."""
        return SubspaceBatch(
            self.feet[index],
            self.numbers[index].astype(np.float32) * self.steps[index][:, :, None],
        )

    @property
    def n(self) -> int:
        """Descriptor dimension."""
        return int(self.numbers.shape[2])

    @property
    def m(self) -> int:
        """Subspace dimension."""
        return int(self.numbers.shape[1])

    @property
    def is_finite(self) -> bool:
        """Whether no number is infinite or NaN."""
        return is_finite(self.feet) and is_finite(self.steps)
