"""What a point's similarity to a template of nobody is expected to be, in closed form.

A decision is taken by ``(similarity − mean) / spread``: how far a probe is nearer to one template
than to templates of nobody. Mean and spread are functions of the probe x alone, through H, the mean
projector of templates of nobody, and p̄, their mean foot point: of √(xᵀHx), xᵀHx, ‖Hx‖, ‖Hx‖² and
x·p̄. The Euclidean mean is exactly such a function; the others are fitted (``verify.expectation``;
docs/decision.md §1). A *wolf*, a probe near everybody's template, has a high mean.

Nothing here is secret: whoever knows how templates are lifted can compute it.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from templates.distances import Metric
from templates.errors import ContractError

Array64 = NDArray[np.float64]

LEAST_SPREAD = 1e-6
"""Floor of a spread: keeps the score finite for a probe that is equally far from all templates."""
FEATURES = 6
EXPECTATION_TENSORS = frozenset({"projector", "foot", "mean", "log_spread", "metric"})
_LARGEST_COEFFICIENT = 1e6
_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False, repr=False)
class PointExpectation:
    """Mean and spread of a point's similarities to templates of nobody.

    Parameters
    ----------
    metric
        Of the similarities.
    projector : (n, n) float32
        H = E[DᵀD] of the bases D of templates of nobody; symmetric.
    foot : (n,) float32
        p̄, their mean foot point.
    mean, log_spread : (6,) float64
        Coefficients of √(xᵀHx), xᵀHx, ‖Hx‖, ‖Hx‖², x·p̄ and 1 for the mean, and for the logarithm of
        the spread.
    """

    metric: Metric
    projector: NDArray[np.float32]
    foot: NDArray[np.float32]
    mean: Array64
    log_spread: Array64

    def check(self, n: int) -> None:
        """Refuse what cannot be the expectation of a contract for descriptors of n numbers.

        Raises
        ------
        ContractError
        """
        if self.projector.shape != (n, n) or self.foot.shape != (n,):
            raise ContractError("the expectation's dimension differs from the binding's")
        if self.mean.shape != (FEATURES,) or self.log_spread.shape != (FEATURES,):
            raise ContractError("the expectation has another number of coefficients")
        coefficients = np.concatenate([self.mean, self.log_spread])
        if not (
            np.isfinite(self.projector).all()
            and np.isfinite(self.foot).all()
            and np.isfinite(coefficients).all()
        ):
            raise ContractError("the expectation holds a number that is not finite")
        # A mean of projectors has no eigenvalue, and so no entry, beyond 1.
        if max(np.abs(self.projector).max(), np.abs(self.foot).max()) > 1 + _TOLERANCE:
            raise ContractError("the expectation holds a number larger than 1")
        if np.abs(coefficients).max() > _LARGEST_COEFFICIENT:
            raise ContractError("a coefficient of the expectation is out of range")
        if not np.array_equal(self.projector, self.projector.T):
            raise ContractError("the expectation's projector is not symmetric")

    def statistics(self, points: NDArray[np.floating]) -> tuple[Array64, Array64]:
        """Expected similarity to a template of nobody, and its spread, each (P,).

        Parameters
        ----------
        points : (P, n) floating
            Probes, un-rotated. The spherical metric sees only their directions.
        """
        squares = np.einsum("pi,pi->p", points, points, dtype=np.float64)
        if self.metric is Metric.SPHERICAL:
            lengths = np.sqrt(np.maximum(squares, np.finfo(np.float64).tiny))
            points = points / np.where(squares > 0, lengths, 1.0)[:, None]
        features = point_features(points, self.projector, self.foot)
        means = features @ self.mean
        if self.metric is Metric.EUCLIDEAN:
            means += (1 - squares) / 2  # the coefficients are those of unit points
        spreads = np.exp(np.clip(features @ self.log_spread, -30.0, 30.0))
        return means, np.maximum(spreads, LEAST_SPREAD)

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 over all of its numbers, little-endian."""
        digester = hashlib.sha256(f"{self.metric} {len(self.foot)}".encode())
        for array, kind in (
            (self.projector, "<f4"),
            (self.foot, "<f4"),
            (self.mean, "<f8"),
            (self.log_spread, "<f8"),
        ):
            digester.update(np.ascontiguousarray(array, dtype=kind).tobytes())
        return digester.digest()

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """Arrays that :meth:`from_tensors` reads; of the projector its upper triangle."""
        upper = np.triu_indices(len(self.foot))
        return {
            "projector": np.ascontiguousarray(self.projector[upper]),
            "foot": np.ascontiguousarray(self.foot),
            "mean": self.mean,
            "log_spread": self.log_spread,
            "metric": np.frombuffer(self.metric.encode("ascii"), dtype=np.uint8),
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, NDArray[np.generic]]) -> "PointExpectation":
        """Read what :meth:`tensors` gave; :meth:`check` checks the numbers.

        Raises
        ------
        ContractError
            Where the arrays cannot be that.
        """
        kinds = {name: str(array.dtype) for name, array in tensors.items()}
        if kinds != {
            "projector": "float32",
            "foot": "float32",
            "mean": "float64",
            "log_spread": "float64",
            "metric": "uint8",
        }:
            raise ContractError("the expectation's arrays are not of their types")
        metric = tensors["metric"].tobytes().decode("ascii", errors="replace")
        if metric not in list(Metric):
            raise ContractError("the expectation's metric is unknown")
        foot, triangle = tensors["foot"], tensors["projector"]
        n = len(foot) if foot.ndim == 1 else 0
        if not n or triangle.shape != (n * (n + 1) // 2,):
            raise ContractError("the expectation's arrays do not fit each other")
        projector = np.zeros((n, n), dtype=np.float32)
        upper = np.triu_indices(n)
        projector[upper] = triangle
        projector.T[upper] = triangle
        return cls(
            metric=Metric(metric),
            projector=projector,
            foot=np.asarray(foot, dtype=np.float32),
            mean=np.asarray(tensors["mean"], dtype=np.float64),
            log_spread=np.asarray(tensors["log_spread"], dtype=np.float64),
        )


def point_features(
    points: NDArray[np.floating], projector: NDArray[np.float32], foot: NDArray[np.float32]
) -> Array64:
    """Return √(xᵀHx), xᵀHx, ‖Hx‖, ‖Hx‖², x·p̄ and 1 of every point, (P, 6)."""
    rows = np.asarray(points, dtype=np.float32)
    turned = rows @ projector
    inside = np.maximum(np.einsum("pi,pi->p", rows, turned, dtype=np.float64), 0.0)
    squares = np.einsum("pi,pi->p", turned, turned, dtype=np.float64)
    along = np.asarray(rows @ foot, dtype=np.float64)
    ones = np.ones_like(inside)
    return np.stack([np.sqrt(inside), inside, np.sqrt(squares), squares, along, ones], axis=1)
