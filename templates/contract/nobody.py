"""Templates that hide nobody: what a probe is expected to be near to, and templates for a cohort.

A decision is taken by ``(similarity − mean) / spread``: how far a probe is nearer to one template
than to templates of nobody. A *wolf*, a probe near everybody's template, has a high mean. For a
point x both are closed forms of the decoys' mean μ and covariance S. Nothing here is fitted, and
nothing but the cohort's seed is secret: who knows how templates are lifted can compute the rest.
"""

import threading
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from templates.decoys.generator import DecoyGenerator
from templates.distances import Metric
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift, plain_strategy
from templates.space.subspace import SubspaceBatch

Array64 = NDArray[np.float64]

COHORT_SIZE = 200
"""Templates in the cohort of lifted probes."""
LEAST_SPREAD = 1e-6
"""Floor of a spread: keeps the score finite for a probe that is equally far from all templates."""
_STEPS = 5_000
_CONVERGED = 1e-12
_LIFTING = threading.Lock()


class _Forms(NamedTuple):
    """What the closed forms are made of; k numbers, of templates of m directions."""

    projector: Array64
    """H = E[DᵀD] of the bases D, (k, k)."""
    foot: Array64
    """E[p] of the foot points p, (k,)."""
    squared_foot: float
    """E[‖p‖²]."""
    mixed: Array64
    """H − H², (k, k): by how much the projector varies."""
    shift: Array64
    """Covariance of the foot points that the points a template goes through bring, (k, k)."""
    mean: Array64
    """μ, (k,)."""


@dataclass(frozen=True, eq=False, repr=False)
class Nobody:
    """Templates of nobody under one contract.

    Parameters
    ----------
    generator
        Draws decoys, and what the templates hide: the one that lifting clients have, of k axes.
    strategy, m
        Of the contract; hybrid+ and the sub-strategies are taken in their plain forms.
    cohort_seed
        32 bytes that the cohort is lifted from. Secret: it gives the cohort.
    """

    generator: DecoyGenerator
    strategy: Strategy
    m: int
    cohort_seed: bytes = field(repr=False)

    def statistics(self, points: NDArray[np.floating], metric: Metric) -> tuple[Array64, Array64]:
        """Mean and spread of the similarity of points to templates of nobody, each (P,).

        Parameters
        ----------
        points : (P, k) floating
            Unit rows, un-rotated.

        Notes
        -----
        The span of m differences of points with covariance S has, as its projector's expectation,
        H = S (S + λ)⁻¹ with λ such that tr H = m; the variance of xᵀDᵀDx is
        2 (xᵀ(H − H²)x)² / tr(H − H²). Both are deterministic equivalents, exact for many axes.

        References
        ----------
        R. Couillet & Z. Liao, "Random Matrix Methods for Machine Learning", 2022, chapter 2.
        """
        forms = self._forms
        x = np.asarray(points, dtype=np.float64)
        inside = np.maximum(np.einsum("pi,pi->p", x @ forms.projector, x), 1e-12)
        along = x @ forms.foot
        if metric is Metric.SPHERICAL:
            reach = np.sqrt(max(0.0, 1 - forms.squared_foot))
            means = along + reach * np.sqrt(inside)
            slope = reach / (2 * np.sqrt(inside))
        else:
            means = along + (1 + inside - forms.squared_foot) / 2
            slope = np.full(len(x), 0.5)
        turned = x @ forms.mixed
        own, crossed = np.einsum("pi,pi->p", turned, x), turned @ forms.mean
        middle = float(forms.mean @ forms.mixed @ forms.mean)
        trace = max(float(np.trace(forms.mixed)), 1e-12)
        variances = (
            2 * (slope * own) ** 2 - 4 * slope * own * crossed + own * middle + crossed**2
        ) / trace + np.einsum("pi,pi->p", x @ forms.shift, x)
        return means, np.maximum(np.sqrt(np.maximum(variances, 0.0)), LEAST_SPREAD)

    def stranger_similarity(self, templates: SubspaceBatch) -> Array64:
        """How near templates (T, un-rotated) lie to strangers: (T,), in similarities.

        The root mean square over strangers of what lies in a template, and the mean along its foot
        point. A template near strangers on purpose reaches more than any honest one.
        """
        root = self.generator.root.astype(np.float64)
        mean = self.generator.mean.astype(np.float64)
        moments = np.column_stack([root, mean]) / np.sqrt(np.sum(root**2) + mean @ mean)
        inside = np.empty(len(templates))
        for row, basis in enumerate(templates.bases):
            inside[row] = np.linalg.norm(basis.astype(np.float64) @ moments)
        feet = templates.feet.astype(np.float64)
        reach = np.sqrt(np.maximum(0.0, 1 - np.sum(feet**2, axis=1)))
        return np.asarray(feet @ moments[:, -1] + reach * inside)

    def lift(self, stream: Keystream) -> SubspaceBatch:
        """Lift one template of nobody, un-rotated."""
        return self._lift(1, stream)[0]

    @property
    def cohort(self) -> SubspaceBatch:
        """Templates that lifted probes are normalised by; lifted at the first use.

        That takes a second: one thread does it, and others wait.
        """
        with _LIFTING:
            return self._cohort

    @cached_property
    def _cohort(self) -> SubspaceBatch:
        stream = Keystream(self.cohort_seed)
        return self._lift(COHORT_SIZE, stream)

    def _lift(self, count: int, stream: Keystream) -> SubspaceBatch:
        points = self.generator.draw(count, 1, stream=stream)[:, 0]
        return lift(
            points,
            strategy=plain_strategy(self.strategy),
            m=self.m,
            source=self.generator if self.strategy.needs_decoys else None,
            stream=stream,
        )

    @cached_property
    def _forms(self) -> _Forms:
        # Of the decoys as they are drawn: scaled to length 1.
        size = float(np.trace(self.generator.second_moment))
        mean = self.generator.mean.astype(np.float64) / np.sqrt(size)
        variances, axes = np.linalg.eigh(self.generator.covariance / size)
        variances = np.maximum(variances, 0.0)
        decoys = self.strategy.decoys(self.m)
        by_decoys, by_chance = _weights(variances, decoys, self.m - decoys)
        weights = by_decoys * variances + by_chance
        shares = weights / (1 + weights)
        mixed = shares * (1 - shares)
        projector = (axes * shares) @ axes.T
        foot = mean - projector @ mean
        left = variances * (1 - shares)
        trace = max(float(mixed.sum()), 1e-12)
        shift = (axes * (left * (1 - shares))) @ axes.T
        return _Forms(
            projector=projector,
            foot=foot,
            squared_foot=float(mean @ foot + left.sum() / (decoys + 1)),
            mixed=(axes * mixed) @ axes.T,
            shift=shift * (self.m / trace) / (decoys + 1),
            mean=mean,
        )


def _weights(variances: Array64, decoys: int, random: int) -> tuple[float, float]:
    """Weights a and b of S and of the unit matrix: H = A (1 + A)⁻¹ with A = a S + b.

    tr(a S (1 + A)⁻¹) is the number of decoys, and tr(b (1 + A)⁻¹) that of random directions.
    """
    mean = max(float(variances.mean()), 1e-300)
    a, b = float(decoys > 0) / mean, float(random > 0)
    for _ in range(_STEPS):
        rest = 1 / (1 + a * variances + b)
        seen = np.array([a * np.sum(variances * rest), b * np.sum(rest)])
        gains = np.array([decoys, random]) / np.maximum(seen, 1e-300)
        gains[np.array([decoys, random]) == 0] = 1.0
        a, b = a * gains[0], b * gains[1]
        if np.abs(gains - 1).max() < _CONVERGED:
            break
    return a, b
