"""What an attacker's own faces say about where a descriptor may lie: their mean and covariance."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.space.subspace import SubspaceBatch, span_basis


@dataclass(frozen=True, eq=False, repr=False)
class FaceStatistics:
    """A Gaussian model of face descriptors.

    In the coordinates ``whitened`` it is N(0, I): no direction is likelier than another there, so
    what a set of points has in common with a face stands out as far as it can.

    Parameters
    ----------
    mean : (n,) float64
    whitening : (n, n) float64
        Symmetric root of the inverse covariance.
    colouring : (n, n) float64
        Its inverse.
    """

    mean: NDArray[np.float64]
    whitening: NDArray[np.float64]
    colouring: NDArray[np.float64]

    @classmethod
    def of(cls, descriptors: NDArray[np.floating]) -> Self:
        """Estimate from (N, n) descriptors, with the shrinkage of Ledoit and Wolf (2004)."""
        rows = descriptors.astype(np.float64)
        if len(rows) < 2:
            raise AuditError("the statistics of faces need at least two faces of the attacker's")
        from sklearn.covariance import ledoit_wolf

        mean = rows.mean(axis=0)
        values, vectors = np.linalg.eigh(ledoit_wolf(rows - mean, assume_centered=True)[0])
        roots = np.sqrt(np.maximum(values, values[-1] * 1e-6))
        return cls(
            mean=mean,
            whitening=(vectors / roots) @ vectors.T,
            colouring=(vectors * roots) @ vectors.T,
        )

    def whitened(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map points (..., n)."""
        return np.asarray((points.astype(np.float64) - self.mean) @ self.whitening)

    def coloured(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map back."""
        return np.asarray(points @ self.colouring + self.mean)

    def whitened_subspaces(
        self, templates: SubspaceBatch
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Foot points (N, n) and orthonormal bases (N, m, n) of the images of N templates."""
        bases = span_basis(templates.bases.astype(np.float64) @ self.whitening)
        feet = self.whitened(templates.feet)
        inside = (feet[:, None, :] @ bases.transpose(0, 2, 1)) @ bases
        return feet - inside[:, 0, :], bases
