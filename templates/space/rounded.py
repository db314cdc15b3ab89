"""Templates with their bases rounded to eight bits, for sets that are read at every decision.

Each coordinate is first divided by its root mean square over the set, so that one in which people
hardly differ keeps its digits. Then each row of a basis keeps its largest number as 127 steps. The
rows of a basis are a random frame of its directions, so their errors are independent. No stored
template is ever rounded so.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from templates.errors import InvalidTemplate
from templates.space.subspace import SubspaceBatch, is_finite

_MOST = np.float32(127)
_TINY = np.finfo(np.float32).tiny
# Of the mean energy of all coordinates; one with less is rounded as if it had so much.
_LEAST_ENERGY = 1e-12


@dataclass(frozen=True, eq=False, repr=False)
class RoundedBatch:
    """N templates of one dimension, in a quarter of a `SubspaceBatch`'s memory.

    Parameters
    ----------
    feet : ndarray of float32, shape (N, n)
    numbers : ndarray of int8, shape (N, m, n)
    steps : ndarray of float32, shape (N, m)
        Of each row.
    scales : ndarray of float32, shape (n,)
        Of each coordinate: the bases are ``numbers * steps[:, :, None] * scales``.

    Raises
    ------
    InvalidTemplate
        Arrays that do not fit each other.
    """

    feet: NDArray[np.float32]
    numbers: NDArray[np.int8]
    steps: NDArray[np.float32]
    scales: NDArray[np.float32]

    def __post_init__(self) -> None:
        count, m, n = self.numbers.shape
        for name, kind, shape in (
            ("feet", np.float32, (count, n)),
            ("numbers", np.int8, (count, m, n)),
            ("steps", np.float32, (count, m)),
            ("scales", np.float32, (n,)),
        ):
            array = np.ascontiguousarray(getattr(self, name), dtype=kind).view()
            if array.shape != shape:
                raise InvalidTemplate(f"{name} of shape {array.shape} are not of shape {shape}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @classmethod
    def of(cls, batch: SubspaceBatch) -> Self:
        """Round the bases of a batch; the foot points stay as they are."""
        count, m, n = batch.bases.shape
        energies = sum((np.square(basis).sum(axis=0) for basis in batch.bases), np.zeros(n))
        least = max(_LEAST_ENERGY * energies.mean(), _TINY)
        scales = np.sqrt(np.maximum(energies, least) / max(count * m, 1)).astype(np.float32)
        numbers = np.empty((count, m, n), dtype=np.int8)
        steps = np.empty((count, m), dtype=np.float32)
        for i, basis in enumerate(batch.bases):
            rows = basis / scales
            steps[i] = np.maximum(np.abs(rows).max(axis=1) / _MOST, _TINY)
            numbers[i] = np.rint(rows / steps[i, :, None])
        return cls(batch.feet, numbers, steps, scales)

    def __repr__(self) -> str:
        return f"RoundedBatch({len(self)} of n={self.n}, m={self.m})"

    def __len__(self) -> int:
        return int(self.feet.shape[0])

    def restored(self, index: slice | NDArray[np.integer] = slice(None)) -> SubspaceBatch:
        """Return some of the templates, or all, in float32, as they were rounded."""
        bases = self.numbers[index] * self.steps[index][:, :, None]
        bases *= self.scales
        return SubspaceBatch(self.feet[index], bases)

    @property
    def n(self) -> int:
        """Descriptor dimension."""
        return int(self.numbers.shape[2])

    @property
    def m(self) -> int:
        """Subspace dimension."""
        return int(self.numbers.shape[1])

    @cached_property
    def is_finite(self) -> bool:
        """Whether no number is infinite or NaN."""
        return all(map(is_finite, (self.feet, self.steps, self.scales)))
