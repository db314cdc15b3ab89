"""Subspaces with rows of eight bits: one point's similarities to many, at a quarter of the memory.

Where one point meets hundreds of subspaces, reading their rows is all the time that it takes. The
similarities are as good as a mean and a spread over hundreds of them need (about 10⁻³; see
``docs/distances.md``); a decision about one template takes its exact distance.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from templates.distances import exact
from templates.distances.kernels.lanes import LANES
from templates.distances.kernels.rounded import squares_inside
from templates.distances.metric import Metric
from templates.errors import InvalidEmbedding
from templates.space.subspace import SubspaceBatch, is_finite

_LARGEST = 127


@dataclass(frozen=True, eq=False, repr=False)
class RoundedSubspaces:
    """T subspaces of dimension m in R^n, in groups of sixteen; made by :meth:`of`."""

    rows: NDArray[np.int8]
    """(G · m · n · 16,): number by number, sixteen subspaces side by side, the last ones zero."""
    steps: NDArray[np.float32]
    """(G · m · 16,): what a row's numbers are multiples of."""
    feet: NDArray[np.float32]
    scales: NDArray[np.float32]
    radii: NDArray[np.float32]
    m: int

    @classmethod
    def of(cls, batch: SubspaceBatch) -> Self:
        """Round the rows of a batch, each to multiples of 1/127 of its largest number."""
        groups, m, n = -(-len(batch) // LANES), batch.m, batch.n
        rows = np.zeros((groups, m, n, LANES), dtype=np.int8)
        steps = np.zeros((groups, m, LANES), dtype=np.float32)
        for first in range(0, len(batch), LANES):
            bases = batch.bases[first : first + LANES]
            largest = np.abs(bases).max(axis=2, initial=0)
            step = np.maximum(largest, np.finfo(np.float32).tiny) / np.float32(_LARGEST)
            group, count = first // LANES, len(bases)
            rows[group, :, :, :count] = np.rint(bases / step[:, :, None]).transpose(1, 2, 0)
            steps[group, :, :count] = step.T
        scales, radii = exact.spheres(batch.feet)
        return cls(
            rows=rows.reshape(-1),
            steps=steps.reshape(-1),
            feet=batch.feet,
            scales=scales.astype(np.float32),
            radii=radii.astype(np.float32),
            m=m,
        )

    def __len__(self) -> int:
        return len(self.feet)

    def similarities(
        self, point: NDArray[np.float32], *, metric: Metric | str
    ) -> NDArray[np.float32]:
        """Similarities of one point (n,), 1 − distance²/2, at most 1, shape (T,).

        The spherical metric sees only its direction; a zero point has similarity 0. See paper eq. 1
        (Euclidean) and docs/method.md §3.4 (spherical).

        Raises
        ------
        InvalidEmbedding
            Where the point has another shape, or a number that is not finite.
        """
        n = self.feet.shape[1]
        point = np.array(point, dtype=np.float32, order="C")
        if point.shape != (n,):
            raise InvalidEmbedding(f"expected a point of shape ({n},), seen {point.shape}")
        if not is_finite(point):
            raise InvalidEmbedding("a point holds a number that is not finite")
        metric = Metric(metric)
        if metric is Metric.SPHERICAL:
            point = exact.normalised(point.astype(np.float64)).astype(np.float32)
        inside = np.empty(len(self) + -len(self) % LANES, dtype=np.float32)
        squares_inside(self.rows, self.steps, point, self.m, inside)
        inside = inside[: len(self)]
        dots = self.feet @ point
        if metric is Metric.SPHERICAL:
            similar = self.scales * dots + self.radii * np.sqrt(inside)
        else:
            own = np.einsum("ti,ti->t", self.feet, self.feet)
            similar = 1 - (point @ point + own - 2 * dots - inside) / 2
        return np.minimum(similar, np.float32(1))
