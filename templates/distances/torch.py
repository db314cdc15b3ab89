"""Distances on a device of torch (extra ``torch``): float32, a tile at a time.

What float32 gets wrong is computed by ``exact``, on the processor. Only those who ask for a device
import this file.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from templates.distances import exact
from templates.distances.metric import (
    ACCURACY,
    LONGEST,
    NEAR,
    STILL,
    Metric,
    Probes,
    Tile,
    parts,
)
from templates.errors import TemplateError
from templates.space.subspace import SubspaceBatch

_TILE_BYTES = {"cpu": 8 << 20, "cuda": 128 << 20}
"""Size of the products that are made at a time; the computation holds a few times that."""
_EPS, _TINY = torch.finfo(torch.float32).eps, torch.finfo(torch.float32).tiny


class Rows(NamedTuple):
    """Points or subspaces on a device, float32: rows (m + 1, N, n), all feet or points first."""

    rows: Tensor
    squares: Tensor
    """Squared lengths of points or feet, (N,)."""


def usable(device: str) -> torch.device:
    """Name a device; a TemplateError says why torch cannot use it."""
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise TemplateError(
            f"torch cannot use the device {device}: {str(error).splitlines()[0]}"
        ) from None
    return torch.device(device)


def tiles(
    probes: Probes, templates: SubspaceBatch, *, metric: Metric, steps: int, device: str
) -> Iterator[Tile]:
    """Yield rows, columns and distances (R, C) float32 of all parts of the matrix."""
    there = usable(device)
    budget = _TILE_BYTES.get(there.type, 128 << 20) // 4
    deep = probes.m + 1 if isinstance(probes, SubspaceBatch) else 1
    wide = templates.m + 1
    pairs = max(1, budget // (deep * wide))
    # The stacked rows count too: few probes and many templates must not make a long tile.
    height = max(1, min(len(probes), math.isqrt(pairs), budget // (deep * templates.n)))
    width = max(1, min(len(templates), pairs // height, budget // (wide * templates.n)))
    for columns in parts(len(templates), width):
        right = stacked(templates[columns], metric, there)
        for rows in parts(len(probes), height):
            left = stacked(probes[rows], metric, there)
            with ieee_products(there):
                products = left.rows.flatten(0, 1) @ right.rows.flatten(0, 1).T
                shape = len(left.rows), rows.stop - rows.start, wide, columns.stop - columns.start
                block = products.view(shape).permute(1, 3, 0, 2)
                squares = left.squares[:, None], right.squares
                out = _distances(block, *squares, metric=metric, steps=steps).cpu().numpy()
            i, j = np.nonzero(~((out >= NEAR) & (out < np.inf)))
            if i.size:
                sides = probes[rows], templates[columns]
                out[i, j] = exact.pairs(*sides, i, j, metric=metric, steps=steps)
            yield rows, columns, out


def stacked(side: Probes, metric: Metric, device: torch.device) -> Rows:
    """Copy points or subspaces to a device, those of the sphere scaled to it."""
    spherical = metric is Metric.SPHERICAL
    if isinstance(side, SubspaceBatch):
        rows = torch.tensor(side.bases, device=device).transpose(0, 1)
        feet = torch.tensor(side.feet, device=device)
        if spherical:
            scales, radii = (
                torch.tensor(part, dtype=torch.float32, device=device)[:, None]
                for part in exact.spheres(side.feet)
            )
            feet, rows = feet * scales, rows * radii
        rows = torch.cat([feet[None], rows])
    else:
        points = exact.normalised(side.astype(np.float64)) if spherical else side
        rows = torch.tensor(points, dtype=torch.float32, device=device)[None]
    lengths: Tensor = torch.linalg.vector_norm(rows[0], dim=1, dtype=torch.float64)
    return Rows(rows.contiguous(), lengths.square().float())


@contextmanager
def ieee_products(device: torch.device) -> Iterator[None]:
    """Compute float32 products in float32: no TF32, no bfloat16, no autocast, no gradients."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        with torch.no_grad(), torch.autocast(device.type, enabled=False):
            yield
    finally:
        torch.set_float32_matmul_precision(before)


def _distances(
    products: Tensor, own: Tensor, squares: Tensor, *, metric: Metric, steps: int
) -> Tensor:
    """Distances from the products (…, m_D + 1, m_E + 1) of every pair, in their shape.

    What is nearer than 0.1, NaN or infinite has to be computed by ``exact``.

    Parameters
    ----------
    own, squares
        Squared lengths of points or feet, of both sides, in shapes that broadcast.
    """
    shape = products.shape[:-2]
    block = products.reshape(-1, *products.shape[-2:])
    points = block.shape[1] == 1
    if metric is Metric.SPHERICAL:
        gains = block[:, 0, 1:].norm(dim=1) if points else _gains(block, steps)
        squared = (2 - 2 * (block[:, 0, 0] + gains)).view(shape)
        if points:  # a zero probe has no direction: similarity 0 with everything
            squared = torch.where(own > 0, squared, 2.0)
    else:
        gaps = (own + squares).flatten() - 2 * block[:, 0, 0]
        squared = gaps - block[:, 0, 1:].square().sum(dim=1) if points else _schur(block, gaps)
    return squared.clamp(min=0).sqrt().view(shape)


def _schur(block: Tensor, gaps: Tensor) -> Tensor:
    """Squared distances of pairs at ‖p − q‖² = ``gaps``; NaN where they may be inexact.

    With M = D Eᵀ, a = D q and w = −E p − Mᵀa, ‖p − q‖² − ‖a‖² − wᵀ(I − MᵀM)⁻¹w. An error of the
    products moves it by that times the squares of the closest points' coefficients.
    """
    left, middle = block[:, 1:, :1], block[:, 1:, 1:]
    w = block[:, :1, 1:].mT + middle.mT @ left
    normal = torch.eye(middle.shape[2], device=block.device) - middle.mT @ middle
    factor, failed = torch.linalg.cholesky_ex(normal)
    z = torch.linalg.solve_triangular(factor, w, upper=False)
    beta = torch.linalg.solve_triangular(factor.mT, z, upper=True)
    squared: Tensor = gaps - left.square().sum(dim=(1, 2)) - z.square().sum(dim=(1, 2))
    pivots = factor.diagonal(dim1=1, dim2=2).square().amin(dim=1)
    sizes = 1 + 2 * beta.square().sum(dim=(1, 2))
    sound = (failed == 0) & (pivots > 100 * _EPS) & (4 * _EPS * sizes < ACCURACY * squared)
    return squared.masked_fill(~sound, torch.nan)


def _gains(block: Tensor, steps: int) -> Tensor:
    """Maximise F(v), as ``exact.maximise`` from its two starts; pairs at rest make room."""
    g, b = block[:, None, 1:, 0], block[:, 1:, 1:]
    if b.shape[1] < b.shape[2]:  # G is the smaller one
        return _gains(block.mT, steps)
    gram, c, h, g2 = b.mT @ b, g @ b, block[:, None, 0, 1:], g.square().sum(2)
    power = gram
    for _ in range(5):
        power = power / power.diagonal(dim1=1, dim2=2).sum(1).clamp(min=_TINY)[:, None, None]
        power = power @ power
    largest = power.diagonal(dim1=1, dim2=2).argmax(dim=1)
    leading = _normalised(power[torch.arange(len(power), device=power.device), :, largest])
    v = torch.stack([leading, -leading], dim=1)
    values = torch.full_like(v[..., 0], -4)
    active, value = torch.arange(len(v), device=v.device), values
    moved = stepped = torch.zeros_like(v)
    for taken in range(steps):
        turned = v @ gram
        lengths = (g2 + (v * (turned + 2 * c)).sum(2)).clamp(min=_TINY).sqrt()
        following = _normalised(h + (turned + c) / lengths[..., None])
        new = lengths + (v * h).sum(2)
        # Where the extrapolated point is worse than the last one, the plain step comes next.
        worse = new < value - 1e-6
        motion = following - v
        turn = motion - moved
        slope = (motion * turn).sum(2) / turn.square().sum(2).clamp(min=_TINY)
        slope = slope.clamp(-LONGEST, LONGEST)[..., None] * (taken > 0)
        value, again = torch.where(worse, value, new), worse[..., None]
        trial = following - slope * (following - stepped)
        v = _normalised(torch.where(again, stepped, trial))
        moved, stepped = torch.where(again, moved, motion), torch.where(again, stepped, following)
        if taken % 4 == 3 or taken == steps - 1:
            values[active] = value
            left = (worse | (motion.square().sum(2) >= STILL**2)).any(dim=1).nonzero()[:, 0]
            active = active[left]
            v, value, moved, stepped = (part[left] for part in (v, value, moved, stepped))
            gram, c, h, g2 = (part[left] for part in (gram, c, h, g2))
            if not len(active):
                break
    return values.amax(dim=1)


def _normalised(rows: Tensor) -> Tensor:
    """Unit rows along the last axis; a zero row stays zero."""
    units: Tensor = rows / rows.norm(dim=-1, keepdim=True).clamp(min=_TINY)
    return units
