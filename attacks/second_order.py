"""The strongest guess of a descriptor from second moments: of faces, and of the decoys around it.

A template is the span of a descriptor and of decoys. The attacker takes both for normalised draws
of Gaussians, of other second moments, and guesses the point of the span that is likeliest to be
the descriptor, *given that decoys make up all the rest of the span*. That condition is what
``attacks.likelihood`` leaves out, and what tells most where decoys are nearly spread as faces are.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from attacks.errors import AuditError
from templates.space.subspace import SubspaceBatch

RIDGE = 1e-7
"""Share of the largest second moment that is added to all. Small: embedders leave axes on which
faces hardly differ, and there decoys that were fitted to them differ from faces most."""
_TILE = 64

Array64 = NDArray[np.float64]


def second_moment(rows: NDArray[np.floating]) -> Array64:
    """Mean of x xᵀ over (K, n) rows: about the origin, which the spans of templates hold."""
    points = np.asarray(rows, dtype=np.float64)
    return np.asarray(points.T @ points / len(points))


def with_noise_moment(moment: Array64, noise: float) -> Array64:
    """Second moment (n, n) of unit rows once each number has got noise of a variance, as lifted."""
    n = len(moment)
    return np.asarray((moment + noise * np.eye(n)) / (1 + n * noise))


def without_noise_moment(moment: Array64, noise: float) -> Array64:
    """Undo :func:`with_noise_moment`."""
    n = len(moment)
    return np.asarray(moment * (1 + n * noise) - noise * np.eye(n))


def drawn_towards(faces: NDArray[np.floating], decoys: Array64, *, noise: float = 0.0) -> Array64:
    """Second moment of an attacker's faces (A, n) as lifted, as far as so few faces can tell it.

    Parameters
    ----------
    noise
        Of the decoy source, which the attacker knows.

    Notes
    -----
    The mean of a Wishart posterior whose prior weighs as much as n faces: decoys (n, n) are meant
    to be spread as faces are, so what few faces do not tell is what the decoys say.
    """
    count, n = faces.shape
    lifted = with_noise_moment(second_moment(faces), noise)
    return np.asarray((count * lifted + n * decoys) / (count + n))


@dataclass(frozen=True, eq=False, repr=False)
class Moments:
    """Second moments about the origin, and what is computed from them once.

    Parameters
    ----------
    moment : (n, n) float64
    whitening : (n, n) float32
        R with R Rᵀ = moment⁻¹, so that ‖Rᵀx‖² is −2 log of the Gaussian density, less a constant.
    """

    moment: Array64
    whitening: NDArray[np.float32]

    @classmethod
    def of(cls, moment: Array64) -> "Moments":
        """Take (n, n) second moments."""
        values, axes = np.linalg.eigh(moment)
        if not values[-1] > 0:
            raise AuditError("rows that are all zero have no spread")
        variances = np.maximum(values, 0) + RIDGE * values[-1]
        return cls(moment, np.asarray(axes / np.sqrt(variances), dtype=np.float32))

    def within(self, spans: NDArray[np.float32]) -> Array64:
        """B moment⁻¹ Bᵀ of the rows B of every span (T, k, n): (T, k, k)."""
        turned = (spans.reshape(-1, spans.shape[2]) @ self.whitening).reshape(spans.shape)
        return np.asarray(turned @ turned.transpose(0, 2, 1), dtype=np.float64)


def likeliest_descriptors(
    templates: SubspaceBatch, faces: Moments, decoys: Moments | None, *, count: int
) -> Array64:
    """Guess the descriptor of every template, (T, n) unit rows, on the side of the foot point.

    Parameters
    ----------
    faces, decoys
        As far as the attacker knows them; ``decoys`` may be None where ``count`` is 0.
    count
        Decoys in a template, k. Where k < m, the other directions are random, and are removed
        first: a mixture of face-like points alone lies nearest to where faces lie, so the span of
        descriptor and decoys is that of the k + 1 leading axes of the faces' density in the
        template.

    Notes
    -----
    Let Λ_f, Λ_w be the inverse second moments. A normalised Gaussian has the density
    (xᵀΛ_f x)^(−n/2) on the sphere. The span S of x and k further draws has, given x, the density
    of the matrix angular central Gaussian of S modulo x, which is (xᵀΛ_w x)^((n − 1 − k)/2) by the
    Schur complement, but for factors without x [1]_. The guess maximises

        xᵀΛ_w x / xᵀΛ_f x   over x in S,

    the leading generalised eigenvector within S. That leaves k + 1 out of the exponent, which
    would draw the guess towards the leading axis of faces, where the density is high and next to
    no face lies: with it, simulated guesses at m = 128 matched 23 % of other people's photos.

    References
    ----------
    .. [1] Y. Chikuse, "Statistics on Special Manifolds", 2003, chapter 2.
    """
    if decoys is None and count:
        raise AuditError("decoys of unknown spread: the attack needs their second moments")
    out = np.empty((len(templates), templates.n))
    norms = np.maximum(templates.foot_norms, 1e-300)[:, None]
    for start in range(0, len(templates), _TILE):
        rows = slice(start, start + _TILE)
        feet = templates.feet[rows].astype(np.float64)
        units = (feet / norms[rows]).astype(np.float32)
        spans = np.concatenate([units[:, None], templates.bases[rows]], axis=1)
        density = faces.within(spans)
        if count + 1 < spans.shape[1]:
            axes = np.linalg.eigh(density)[1][:, :, : count + 1].transpose(0, 2, 1)
            spans = np.asarray(axes, dtype=np.float32) @ spans
            density = axes @ density @ axes.transpose(0, 2, 1)
        if count == 0 or decoys is None:
            parts = np.ones((len(spans), 1))
        else:
            parts = _leading(decoys.within(spans), density)
        points = np.einsum("ta,tan->tn", parts, spans.astype(np.float64))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        towards = np.einsum("tn,tn->t", points, feet)
        out[rows] = points * np.where(towards < 0, -1.0, 1.0)[:, None]
    return out


def _leading(numerators: Array64, denominators: Array64) -> Array64:
    """Leading generalised eigenvectors of pairs of forms (T, k, k); (T, k)."""
    last = numerators.shape[1] - 1
    return np.stack(
        [
            eigh(above, below, subset_by_index=[last, last])[1][:, 0]
            for above, below in zip(numerators, denominators, strict=True)
        ]
    )
