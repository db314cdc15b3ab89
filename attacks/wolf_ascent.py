"""Lifted wolves by gradient ascent on the decision, against templates that the attacker lifts.

The attacker knows the algorithm and the thresholds, and lifts faces of their own (targets). Raw
probes climb as ``attacks.point_ascent`` says, as what is expected of a point is known to
everybody; for lifted ones the attacker lifts a cohort of nobody like the service's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.point_ascent import ROUNDS, accepted_share, step_lengths
from templates.contract.document import Level
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Array64 = NDArray[np.float64]

_ALTERNATIONS = 12
_ALTERNATIONS_ON = 4
_SEARCH_EVERY = 10


@dataclass(frozen=True, eq=False, repr=False)
class Ground:
    """What a probe climbs on: K subspaces stacked, targets first, the rest is the cohort.

    Parameters
    ----------
    feet : (K, n) float32
    rows : (K m, n) float32
        Bases.
    radii : (K,) float32
    targets
        How many of the K are targets.
    """

    feet: Array32
    rows: Array32
    radii: Array32
    targets: int
    threshold: float

    @classmethod
    def of(cls, targets: SubspaceBatch, cohort: SubspaceBatch, level: Level) -> "Ground":
        """Stack templates of one dimension."""
        bases = np.concatenate([targets.bases, cohort.bases])
        return cls(
            feet=np.concatenate([targets.feet, cohort.feet]),
            rows=bases.reshape(-1, targets.n),
            radii=np.concatenate([targets.radii, cohort.radii]).astype(np.float32),
            targets=len(targets),
            threshold=level.threshold,
        )

    def slopes(self, similarities: Array32) -> tuple[Array64, Array64]:
        """Objective, shape (S,), and its slope by every similarity, shape (S, K).

        Parameters
        ----------
        similarities : (S, K)
            Of S lifted probes to the K subspaces.
        """
        values = similarities.astype(np.float64)
        of_targets, cohort = values[:, : self.targets], values[:, self.targets :]
        mean = cohort.mean(axis=1, keepdims=True)
        spread = np.maximum(cohort.std(axis=1, ddof=1, keepdims=True), 1e-6)
        score = (of_targets - mean) / spread
        objective, by_score = accepted_share(score, self.threshold)
        slopes = np.empty_like(values)
        slopes[:, : self.targets] = by_score / spread
        by_mean = -by_score.sum(axis=1, keepdims=True) / spread
        by_spread = -(by_score * score).sum(axis=1, keepdims=True) / spread
        count = cohort.shape[1]
        slopes[:, self.targets :] = by_mean / count + by_spread * (cohort - mean) / (
            (count - 1) * spread
        )
        return objective, slopes


def ascend_subspaces(starts: SubspaceBatch, ground: Ground) -> SubspaceBatch:
    """Climb with lifted probes, whose foot points keep their norm."""
    ends = [_ascend(starts.feet[row], starts.bases[row], ground) for row in range(len(starts))]
    return SubspaceBatch(np.stack([foot for foot, _ in ends]), np.stack([e for _, e in ends]))


def _ascend(foot: Array32, basis: Array32, ground: Ground) -> tuple[Array32, Array32]:
    norm = float(np.linalg.norm(foot))
    radius = np.float32(np.sqrt(max(0.0, 1 - norm**2)))
    best_foot, best_basis, best_value = foot, basis, -np.inf
    v: Array32 | None = None
    for number, step in enumerate(step_lengths(ROUNDS)):
        # The best v moves little in a step: it is searched for anew now and then only.
        known = None if number % _SEARCH_EVERY == 0 else v
        similarities, v, nearest = _closest(foot, basis, radius, ground, known)
        values, slopes = ground.slopes(similarities[None])
        if values[0] > best_value:
            best_foot, best_basis, best_value = foot, basis, float(values[0])
        weighted = slopes[0].astype(np.float32)[:, None] * nearest
        by_foot, by_basis = weighted.sum(axis=0), radius * (v.T @ weighted)
        pace = step * len(basis) ** 0.5 / max(float(np.linalg.norm(by_basis)), 1e-12)
        moved = np.linalg.qr((basis + np.float32(pace) * by_basis).T)[0].T
        basis = moved.astype(np.float32)
        if norm:
            pace = step * norm / max(float(np.linalg.norm(by_foot)), 1e-12)
            foot = foot + np.float32(pace) * by_foot
        across = foot - (basis @ foot) @ basis
        length = max(float(np.linalg.norm(across)), 1e-12)
        foot = np.asarray(across * (norm / length), dtype=np.float32)
    return best_foot, np.ascontiguousarray(best_basis)


def _closest(
    foot: Array32, basis: Array32, radius: np.float32, ground: Ground, known: Array32 | None
) -> tuple[Array32, Array32, Array32]:
    """Similarities (K,), the best v (K, m_E) and the nearest points (K, n) of the subspaces.

    Found as docs/method.md §3.5 says, from both signs of the leading singular vector; or, where a v
    is known, from there.
    """
    count = len(ground.feet)
    g = ground.radii[:, None] * (ground.rows @ foot).reshape(count, -1)
    h = radius * (ground.feet @ basis.T)
    b = ground.radii[:, None, None] * radius * (ground.rows @ basis.T).reshape(*g.shape, -1)
    transposed = np.ascontiguousarray(b.transpose(0, 2, 1))
    if known is None:
        leading = _leading(transposed @ b)
        starts, alternations = [leading, -leading], _ALTERNATIONS
    else:
        starts, alternations = [known], _ALTERNATIONS_ON
    best_value = np.full(count, -np.inf, dtype=np.float32)
    best_u, best_v = np.zeros_like(g), np.zeros_like(h)
    for v in starts:
        for _ in range(alternations):
            u = normalised(g + (v[:, None, :] @ transposed)[:, 0, :])
            v = normalised(h + (u[:, None, :] @ b)[:, 0, :])
        value = np.einsum("ki,ki->k", u, g + (v[:, None, :] @ transposed)[:, 0, :])
        value += np.einsum("ki,ki->k", v, h)
        better = value > best_value
        best_value = np.where(better, value, best_value)
        best_u[better], best_v[better] = u[better], v[better]
    inside = (ground.radii[:, None] * best_u)[:, None, :]
    nearest = ground.feet + (inside @ ground.rows.reshape(count, -1, len(foot)))[:, 0, :]
    return ground.feet @ foot + best_value, best_v, nearest


def _leading(square: Array32) -> Array32:
    """Leading eigenvectors of positive matrices (K, m, m): a column of a power, normalised."""
    power = square
    for _ in range(3):
        power = power / np.maximum(np.einsum("kii->k", power), 1e-12)[:, None, None]
        power = power @ power
    largest = np.argmax(np.einsum("kii->ki", power), axis=1)
    return normalised(power[np.arange(len(power)), :, largest])
