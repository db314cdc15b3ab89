"""The dual form of a template: n − m hyperplanes instead of m directions (supplement A).

Point to subspace costs n − m products instead of m, which is better when m ≥ n/2. The
subspace-to-subspace system of 3n − 2m unknowns is singular as soon as 2m > n (docs/method.md §3.3),
where the primal form decides; it is kept in float64 as an independent check for 2m < n.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.errors import TemplateError


@dataclass(frozen=True, eq=False, repr=False)
class DualSubspace:
    """The set of all x with normals @ (x − foot) = 0.

    Parameters
    ----------
    foot : ndarray of float64, shape (n,)
    normals : ndarray of float64, shape (n - m, n)
        Orthonormal rows.
    """

    foot: NDArray[np.float64]
    normals: NDArray[np.float64]

    @classmethod
    def of_primal(cls, foot: ArrayLike, basis: ArrayLike) -> Self:
        """Return the dual form of ``foot + span(basis)``, shapes (n,) and (m, n)."""
        rows = np.asarray(basis, dtype=np.float64)
        complete, _ = np.linalg.qr(rows.T, mode="complete")
        normals = np.ascontiguousarray(complete[:, len(rows) :].T)
        return cls(np.asarray(foot, dtype=np.float64), normals)

    def __repr__(self) -> str:
        return f"DualSubspace(n={self.n}, m={self.m})"

    @property
    def n(self) -> int:
        """Descriptor dimension."""
        return int(self.foot.shape[0])

    @property
    def m(self) -> int:
        """Subspace dimension."""
        return self.n - int(self.normals.shape[0])

    def distance_to_points(self, points: ArrayLike) -> NDArray[np.float64]:
        """Euclidean distances of ``points``, shape (k, n), to the set, shape (k,)."""
        offsets = np.asarray(points, dtype=np.float64) - self.foot
        return np.asarray(np.linalg.norm(offsets @ self.normals.T, axis=-1))

    def distance_to_subspace(self, other: "DualSubspace") -> float:
        """Euclidean distance to another set, by the system of supplement A.

        Raises
        ------
        TemplateError
            The descriptor dimensions differ, or the two subspace dimensions add up to more than
            n, where the system is singular by construction: use the primal form.

        Notes
        -----
        The unknowns are x* and the multipliers μ, ν of both sets' normals: 3n − 2m of them for
        two m-dimensional sets. Subspaces that share a direction make the system singular too;
        its minimum-norm least-squares solution still yields the distance.
        """
        n = self.n
        if other.n != n:
            raise TemplateError(f"subspaces of R^{n} and of R^{other.n} have no distance")
        if self.m + other.m > n:
            raise TemplateError(
                f"the dual system is singular for dimensions {self.m} and {other.m} in R^{n}: "
                "use the primal form"
            )
        own, others = self.normals, other.normals
        system = np.block(
            [
                [own, np.zeros((len(own), len(own))), np.zeros((len(own), len(others)))],
                [others, np.zeros((len(others), len(own))), np.eye(len(others))],
                [np.zeros((n, n)), own.T, -others.T],
            ]
        )
        right_side = np.concatenate([own @ self.foot, others @ other.foot, np.zeros(n)])
        solution = np.linalg.lstsq(system, right_side, rcond=None)[0]
        multipliers = solution[n + len(own) :]
        return float(np.linalg.norm(multipliers @ others))  # y* − x* = Σ νⱼ eⱼ
