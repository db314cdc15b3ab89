"""Wolves: lifted probes near every face, built from principal axes (docs/method.md §4.7)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.space.subspace import SubspaceBatch

Array = NDArray[np.float64]

AXES = 64
CENTRAL = "axes through the origin"
ALONG_MEAN = "foot point along the mean face"
_FOOT_FACTORS = (0.8, 1.0, 1.2)


@dataclass(frozen=True, eq=False, repr=False)
class Wolf:
    """A lifted probe that is built to lie near everybody."""

    family: str
    subspace: SubspaceBatch


def axis_wolves(faces: NDArray[np.float32], m: int, *, foot_norm: float, seed: int) -> list[Wolf]:
    """Wolf probes of dimension m that are learnt from (N, n) unit descriptors.

    Parameters
    ----------
    foot_norm
        Norm of an honest probe's foot point; wolves have it, a fifth less and a fifth more, and 0.
    """
    rng = np.random.default_rng(seed)
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2][:AXES].astype(np.float64)
    uncentred = np.linalg.svd(faces.astype(np.float64), full_matrices=False)[2][:AXES]

    def bases() -> Iterator[Array]:
        yield axes[:m]
        yield uncentred[:m]
        yield axes[m : 2 * m]
        for width in (2, 4):
            taken = axes[: width * m]
            for _ in range(4):
                mix = np.linalg.qr(rng.standard_normal((len(taken), m)))[0]
                yield mix.T @ taken

    wolves = []
    for basis in bases():
        wolves.append(Wolf(CENTRAL, canonical(np.zeros_like(mean), basis)))
        for factor in _FOOT_FACTORS:
            direction = mean - basis.T @ (basis @ mean)
            foot = factor * foot_norm * direction / np.linalg.norm(direction)
            wolves.append(Wolf(ALONG_MEAN, canonical(foot, basis)))
    return wolves


def canonical(foot: Array, basis: Array) -> SubspaceBatch:
    """Orthonormalise a basis (m, n), and make the foot point (n,) orthogonal to it."""
    orthonormal = np.linalg.qr(basis.T)[0].T
    return SubspaceBatch(
        feet=(foot - orthonormal.T @ (orthonormal @ foot)).astype(np.float32),
        bases=np.ascontiguousarray(orthonormal, dtype=np.float32),
    )
