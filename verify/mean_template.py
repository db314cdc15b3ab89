"""Mean projector and mean foot point of templates of nobody, from a thousand of them.

What a probe is expected to be near to rests on both (``templates.contract.expectation``), and an
ascent on the decision finds the direction, among n, in which their sampling error is largest. The
mean of a thousand projectors is off by half a deviation there, which 16 n of them halve, at 20
times the cost of all else. But most of what sampling leaves off the diagonal, in the principal axes
of decoys, is noise: decoys are spread alike on both sides of every minor axis. So the entries there
are those that the second moments of decoys and of faces explain, and of the rest the share on which
two halves of the templates agree.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from templates.decoys import DecoyGenerator, DecoySource
from templates.decoys.statistics import band_edges, leading_axes

Array64 = NDArray[np.float64]
Templates: TypeAlias = tuple[Array64, Array64]
"""Feet (T, n) and bases (T, m, n)."""


@dataclass(frozen=True, eq=False, repr=False)
class MeanTemplate:
    """Sums over templates of nobody, in two halves.

    Parameters
    ----------
    projectors : (2, n, n) float64
        Sums of DᵀD.
    feet : (2, n) float64
        Sums of foot points.
    counts : (2,) int64
    """

    projectors: Array64
    feet: Array64
    counts: NDArray[np.int64]

    @classmethod
    def empty(cls, n: int) -> "MeanTemplate":
        """Start with no template."""
        return cls(np.zeros((2, n, n)), np.zeros((2, n)), np.zeros(2, dtype=np.int64))

    def add(
        self, half: int, draw: Callable[[int], Templates], count: int, *, tile: int
    ) -> Iterator[Templates]:
        """Draw templates, a tile at a time, and hand on each once it is added to a half."""
        for first in range(0, count, tile):
            feet, bases = draw(min(tile, count - first))
            rows = bases.astype(np.float32).reshape(-1, bases.shape[2])
            self.projectors[half] += rows.T @ rows
            self.feet[half] += feet.sum(axis=0)
            self.counts[half] += len(feet)
            yield feet, bases

    def estimate(self, sources: Sequence[DecoySource]) -> tuple[Array64, Array64]:
        """Estimate the means over all such templates: (n, n), symmetric, and (n,).

        Parameters
        ----------
        sources
            What decoys are drawn from, and then what the templates hide. Of generators, the second
            moments and means are used.
        """
        halves = self.projectors / self.counts[:, None, None]
        feet = self.feet / self.counts[:, None]
        known = [source.statistics for source in sources if isinstance(source, DecoyGenerator)]
        moments = [statistics.second_moment for statistics in known]
        n = feet.shape[1]
        axes = np.linalg.eigh(moments[0])[1][:, ::-1] if moments else np.eye(n)
        lead = leading_axes(n)
        parts = (slice(0, lead), slice(lead, n))
        turned = axes.T @ halves @ axes
        explaining = [axes.T @ moment @ axes for moment in moments]
        for rows in parts:
            for columns in parts:
                block = np.s_[rows, columns]
                off = np.ones(turned[0][block].shape, dtype=np.bool_)
                if rows == columns:
                    np.fill_diagonal(off, False)
                told = [moment[block][off] for moment in explaining]
                agreed = _agreed(turned[0][block][off], turned[1][block][off], told)
                mean = turned[:, rows, columns].mean(axis=0)
                mean[off] = agreed
                turned[:, rows, columns] = mean
        projector = axes @ turned[0] @ axes.T
        turned_feet = feet @ axes
        means = [statistics.mean.astype(np.float64) @ axes for statistics in known]
        # What explains a foot point differs by the variance along an axis.
        foot = np.concatenate(
            [
                _agreed(
                    turned_feet[0, first:last],
                    turned_feet[1, first:last],
                    [mean[first:last] for mean in means],
                )
                for first, last in pairwise([0, *band_edges(n)])
            ]
        )
        return (projector + projector.T) / 2, axes @ foot


def _agreed(first: Array64, second: Array64, told: Sequence[Array64]) -> Array64:
    """Mean of two noisy rows: what least squares explain, and the share of the rest they agree on.

    The expectation of the product of both residuals is the variance of what is no noise.
    """
    mean = (first + second) / 2
    fit = np.zeros_like(mean)
    if told and len(mean) > len(told):
        design = np.stack(told, axis=1)
        fit = design @ np.linalg.lstsq(design, mean, rcond=None)[0]
    rest = mean - fit
    common = float(np.mean((first - fit) * (second - fit)))
    whole = float(np.mean(rest**2))
    share = min(max(common / whole, 0.0), 1.0) if whole > 0 else 0.0
    return np.asarray(fit + share * rest)
