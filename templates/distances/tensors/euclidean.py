"""Euclidean distances on tensors (paper eq. 1 to 9); ``templates.distances.euclidean`` is the reference."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from templates.distances.euclidean import NEAR
from templates.distances.tensors.subspaces import (
    SubspaceTensors,
    blocks,
    chunks,
    fused,
    products,
    stacked,
)

# The constants of the reference, for float32.
PRECISION = torch.finfo(torch.float32).eps
SMALLEST_PIVOT = 100 * PRECISION
BULK_ERROR = 5e-5
_SHARED_ANGLE2 = 4e-12


def points(probes: Tensor, templates: SubspaceTensors) -> Tensor:
    """Distances of points (P, n) to templates, shape (P, T)."""
    matrix = probes @ stacked(templates.feet, templates.bases).T
    gram = matrix.view(len(probes), templates.m + 1, len(templates))
    spreads = torch.linalg.vector_norm(gram[:, 1:], dim=1).square_()
    squared = _squares(probes)[:, None] + _squares(templates.feet)
    squared -= 2 * gram[:, 0]
    squared -= spreads
    return _finished(squared, points_exact, probes, templates)


def points_exact(probes: Tensor, templates: SubspaceTensors, i: Tensor, j: Tensor) -> Tensor:
    """Distances of points ``i`` to templates ``j`` by explicit residuals in float64, shape (K,)."""
    out = torch.empty(len(i), dtype=torch.float64, device=i.device)
    for part in chunks(len(i), 2 * templates.m * templates.n, i.device):
        bases = templates.bases[j[part]].double()
        gaps = (probes[i[part]].double() - templates.feet[j[part]].double())[:, :, None]
        for _ in range(2):  # once more, because the stored basis is orthonormal to float32 only
            gaps = gaps - bases.mT @ (bases @ gaps)
        out[part] = torch.linalg.vector_norm(gaps[:, :, 0], dim=1)
    return out


def subspaces(probes: SubspaceTensors, templates: SubspaceTensors) -> Tensor:
    """Distances of all probes to all templates, shape (P, T); the probes' m is the larger one."""
    gram = products((probes.feet, probes.bases), (templates.feet, templates.bases))
    mine, theirs = _squares(probes.feet), _squares(templates.feet)
    kernels = fused(probes.device, templates.m)
    if kernels is None:
        gaps = mine[:, None] + theirs - 2 * gram[0, :, 0]
        squared = schur(blocks(gram), gaps.flatten()).view(gaps.shape)
    else:
        squared = kernels.schur(gram, mine, theirs)
    return _finished(squared, subspaces_exact, probes, templates)


def schur(block: Tensor, gaps: Tensor) -> Tensor:
    """Squared distances by the block formula, shape (K,); NaN where they may be inexact.

    Parameters
    ----------
    block : Tensor of float32, shape (K, m_D + 1, m_E + 1)
        Products of the rows [p; D] and [q; E].
    gaps : Tensor of float32, shape (K,)
        ‖p − q‖².

    Notes
    -----
    As ``templates.distances.euclidean._schur``, with one elimination of [[I − MᵀM, w], [wᵀ, ·]] for all
    pairs at once and its test of exactness.
    """
    left, middle = block[:, 1:, 0], block[:, 1:, 1:]
    count, _, m = middle.shape
    w = -block[:, 0, 1:] - (middle.mT @ left[:, :, None])[:, :, 0]
    normal = torch.eye(m, device=block.device) - middle.mT @ middle
    system = torch.cat([normal, w[:, None]], dim=1).permute(1, 2, 0).contiguous()
    squared = gaps - left.square().sum(dim=1)
    doubtful = torch.zeros(count, dtype=torch.bool, device=block.device)
    for step in range(m):
        pivot = system[step, step]
        doubtful |= ~(pivot > SMALLEST_PIVOT)
        root = pivot.clamp(min=SMALLEST_PIVOT).sqrt()
        column = system[step + 1 :, step].div_(root)
        squared -= column[-1].square()
        system[step + 1 :, step + 1 :] -= column[:, None] * column[None, :-1]
        system[step, step] = root
    beta = system[m]
    for step in range(m - 1, -1, -1):
        beta[step] /= system[step, step]
        beta[:step] -= system[step, :step] * beta[step]
    sizes = 1 + 2 * beta.square().sum(dim=0)
    doubtful |= ~(4 * PRECISION * sizes < BULK_ERROR * squared)
    return squared.masked_fill_(doubtful, torch.nan)


def subspaces_exact(
    probes: SubspaceTensors, templates: SubspaceTensors, i: Tensor, j: Tensor
) -> Tensor:
    """Distances of probes ``i`` to templates ``j`` from differences in float64, shape (K,).

    The minimum-norm least squares of ``templates.distances.euclidean.subspaces_exact``: 0 only if the
    residual is, and defined for parallel and for intersecting subspaces.
    """
    out = torch.empty(len(i), dtype=torch.float64, device=i.device)
    for part in chunks(len(i), 2 * (probes.m + templates.m) * probes.n, i.device):
        mine, theirs = i[part], j[part]
        rows = torch.cat([probes.bases[mine], templates.bases[theirs]], dim=1).double()
        values, vectors = torch.linalg.eigh(rows @ rows.mT)
        inverse = torch.where(
            values > _SHARED_ANGLE2, 1 / values.clamp(min=_SHARED_ANGLE2), torch.zeros_like(values)
        )[:, :, None]
        gaps = templates.feet[theirs].double() - probes.feet[mine].double()
        gaps = gaps[:, :, None]
        for _ in range(2):  # the second pass removes the first one's rounding
            inside = inverse * (vectors.mT @ (rows @ gaps))
            gaps = gaps - rows.mT @ (vectors @ inside)
        out[part] = torch.linalg.vector_norm(gaps[:, :, 0], dim=1)
    return out


def _finished(
    squared: Tensor,
    exact: Callable[[Any, SubspaceTensors, Tensor, Tensor], Tensor],
    probes: Tensor | SubspaceTensors,
    templates: SubspaceTensors,
) -> Tensor:
    """Roots of squared distances (P, T), with the close and the doubtful pairs made again."""
    i, j = torch.nonzero(~((squared >= NEAR**2) & (squared < torch.inf)), as_tuple=True)
    distances = squared.clamp_(min=0).sqrt_()
    if len(i):
        distances[i, j] = exact(probes, templates, i, j).float()
    return distances


def _squares(rows: Tensor) -> Tensor:
    """Squared lengths of rows, summed in float64."""
    norms: Tensor = torch.linalg.vector_norm(rows, dim=1, dtype=torch.float64)
    return norms.square().float()
