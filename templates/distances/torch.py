"""Distances on a device, in plain torch: float32, a tile at a time.

What float32 gets wrong is computed by ``exact``, on the processor. Only those who ask for a device
import this file: torch is an optional extra of the project.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from templates.distances import exact
from templates.distances.metric import ACCURACY, LONGEST, NEAR, STILL, Labels, Metric, parts
from templates.errors import TemplateError
from templates.space.subspace import SubspaceBatch

TILE_BYTES = defaultdict(lambda: 128 << 20, cpu=8 << 20)
"""Size of the products that are made at a time; the whole computation holds a few times that."""

_EPS, _TINY = torch.finfo(torch.float32).eps, torch.finfo(torch.float32).tiny
# No pair: behind every distance, and behind the index of every template.
_NOTHING = torch.iinfo(torch.int64).max


@dataclass(frozen=True, eq=False, repr=False)
class SubspaceTensors:
    """N templates of one dimension on one device: feet (N, n), bases (N, m, n), both float32."""

    feet: Tensor
    bases: Tensor

    @classmethod
    def of(cls, batch: SubspaceBatch, device: torch.device | str) -> Self:
        """Copy a batch to a device."""
        return cls(*(torch.tensor(part, device=device) for part in (batch.feet, batch.bases)))

    def __len__(self) -> int:
        return self.feet.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Self:
        return type(self)(self.feet[index], self.bases[index])

    @property
    def n(self) -> int:
        """Descriptor dimension."""
        return self.bases.shape[2]

    @property
    def m(self) -> int:
        """Subspace dimension."""
        return self.bases.shape[1]

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.feet.device


Side = Tensor | SubspaceTensors


def pairwise(probes: Side, templates: SubspaceTensors, *, metric: Metric, steps: int) -> Tensor:
    """Distances of every probe, points (P, n) or subspaces, to every template, (P, T)."""
    out = torch.empty(len(probes), len(templates), device=templates.device)
    with ieee_products(templates.device):
        for rows, columns, distances in _tiles(probes, templates, metric, steps):
            out[rows, columns] = distances
    return out


def paired(
    probes: SubspaceTensors, templates: SubspaceTensors, *, metric: Metric, steps: int
) -> Tensor:
    """Distances of subspace i to subspace i, (P,)."""
    out = torch.empty(len(templates), device=templates.device)
    numbers = (probes.m + templates.m + 2) * probes.n + (probes.m + 1) * (templates.m + 1)
    step = max(1, TILE_BYTES[templates.device.type] // 4 // numbers)
    with ieee_products(templates.device):
        for part in parts(len(templates), step):
            out[part] = _distances(probes[part], templates[part], metric, steps, paired=True)
    return out


def nearest(
    probes: Side,
    templates: SubspaceTensors,
    k: int,
    *,
    of_templates: bool = False,
    labels: Labels | None = None,
    **options: Any,
) -> tuple[Tensor, Tensor]:
    """Indices and distances of the k nearest, as ``templates.distances.nearest`` finds them."""
    there = templates.device
    best = torch.full((len(templates if of_templates else probes), k), _NOTHING, device=there)
    with ieee_products(there):
        for rows, columns, distances in _tiles(probes, templates, **options):
            # A distance is not negative, so its bits ascend with it.
            keys = distances.abs().contiguous().view(torch.int32).long() << 32
            _drop(keys, labels, rows, columns, _NOTHING)
            if of_templates:
                rows, columns, keys = columns, rows, keys.T
            keys = keys | torch.arange(columns.start, columns.stop, device=there)
            keys = torch.cat([best[rows], keys], dim=1)
            best[rows] = torch.topk(keys, k, dim=1, largest=False).values
    nothing = best == _NOTHING
    distances = (best >> 32).int().view(torch.float32).masked_fill(nothing, torch.inf)
    return (best & 0xFFFFFFFF).masked_fill_(nothing, -1), distances


def counts_within(
    probes: Side,
    templates: SubspaceTensors,
    thresholds: NDArray[np.float64],
    *,
    labels: Labels | None = None,
    **options: Any,
) -> Tensor:
    """Numbers of pairs up to each threshold, int64; thresholds ascend."""
    bounds = torch.tensor(thresholds, dtype=torch.float64, device=templates.device)
    counts = torch.zeros(len(bounds) + 1, dtype=torch.int64, device=templates.device)
    with ieee_products(templates.device):
        for rows, columns, distances in _tiles(probes, templates, **options):
            places = torch.searchsorted(bounds, distances.double().contiguous())
            _drop(places, labels, rows, columns, len(bounds))
            counts += torch.bincount(places.flatten(), minlength=len(counts))
    return counts[:-1].cumsum(0)


@contextmanager
def ieee_products(device: torch.device) -> Iterator[None]:
    """Compute float32 products in float32: no TF32, no bfloat16, no autocast, no gradients.

    torch has an older and a newer setting for this and refuses to read the older one where only
    the newer has been changed. Setting the older one sets both.
    """
    parts = torch.backends.cuda, torch.backends.mkldnn
    backends: list[Any] = [part.matmul for part in parts if hasattr(part, "matmul")]
    newer = [getattr(backend, "fp32_precision", None) for backend in backends]
    try:
        older = torch.get_float32_matmul_precision()
    except RuntimeError:
        older = None
    torch.set_float32_matmul_precision("highest")
    try:
        with torch.no_grad(), torch.autocast(device.type, enabled=False):
            yield
    finally:
        if older is not None:
            torch.set_float32_matmul_precision(older)
        else:
            for backend, precision in zip(backends, newer, strict=True):
                backend.fp32_precision = precision


def stacked(side: Side) -> Tensor:
    """Points, or rows [p; D] with all feet first, then all first directions, ((m + 1) · N, n)."""
    if isinstance(side, Tensor):
        return side
    return torch.cat([side.feet[None], side.bases.transpose(0, 1)]).flatten(0, 1)


def usable(device: str) -> torch.device:
    """Name a device; a TemplateError says why torch cannot use it."""
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise TemplateError(
            f"torch cannot use the device {device}: {str(error).splitlines()[0]}"
        ) from None
    return torch.device(device)


def placed(side: NDArray[Any] | SubspaceBatch, device: torch.device) -> Side:
    """Copy points or subspaces to a device."""
    if isinstance(side, SubspaceBatch):
        return SubspaceTensors.of(side, device)
    return torch.tensor(side, dtype=torch.float32, device=device)


def _drop(table: Tensor, labels: Labels | None, rows: slice, columns: slice, value: int) -> None:
    """Overwrite the pairs of a tile that have equal labels."""
    if labels is not None:
        left, right = (torch.as_tensor(side, device=table.device) for side in labels)
        table.masked_fill_(left[rows, None] == right[columns], value)


# --- one tile ------------------------------------------------------------------------------------


def _tiles(
    probes: Side, templates: SubspaceTensors, metric: Metric, steps: int
) -> Iterator[tuple[slice, slice, Tensor]]:
    """Yield rows, columns and their distances, the columns of one row of tiles in order."""
    rows, columns, budget = len(probes), len(templates), TILE_BYTES[templates.device.type] // 4
    deep, wide = 1 if isinstance(probes, Tensor) else probes.m + 1, templates.m + 1
    pairs = max(1, budget // (deep * wide))
    # The stacked rows count too: few probes and many templates must not make a long tile.
    height = max(1, min(rows, math.isqrt(pairs), budget // (deep * templates.n)))
    width = max(1, min(columns, pairs // height, budget // (wide * templates.n)))
    for row in parts(rows, height):
        for column in parts(columns, width):
            yield row, column, _distances(probes[row], templates[column], metric, steps)


def _distances(
    probes: Side, templates: SubspaceTensors, metric: Metric, steps: int, *, paired: bool = False
) -> Tensor:
    """Distances of one tile, shape (P, T), or of probe i to template i, shape (P,)."""
    spherical = metric is Metric.SPHERICAL
    left, right = (_on_sphere(side) if spherical else side for side in (probes, templates))
    # Products of every pair: (pairs, m_D + 1, m_E + 1), m_D = 0 for points.
    rows, columns = stacked(left), stacked(right)
    if paired:
        rows, columns = (part.view(-1, len(probes), templates.n) for part in (rows, columns))
        block = rows.transpose(0, 1) @ columns.permute(1, 2, 0)
    else:
        gram = (rows @ columns.T).view(-1, len(probes), templates.m + 1, len(templates))
        block = gram.permute(1, 3, 0, 2).flatten(0, 1).contiguous()
    if spherical:
        gains = block[:, 0, 1:].norm(dim=1) if isinstance(left, Tensor) else _gains(block, steps)
        squared = 2 - 2 * (block[:, 0, 0] + gains)
    else:
        squares = _squares(left) if paired else _squares(left)[:, None]
        gaps = (squares + _squares(right)).flatten() - 2 * block[:, 0, 0]
        lifted = not isinstance(left, Tensor)
        squared = _schur(block, gaps) if lifted else gaps - block[:, 0, 1:].square().sum(dim=1)
    distances = squared.clamp(min=0).sqrt()
    if not paired:
        distances = distances.view(len(probes), len(templates))
    near = torch.nonzero(~((distances >= NEAR) & (distances < torch.inf)), as_tuple=True)
    if len(near[0]):
        i, j = (index.cpu().numpy() for index in (near[0], near[-1]))
        sides = _on_processor(probes), _on_processor(templates)
        corrected = exact.pairs(*sides, i, j, metric=metric, steps=steps)
        distances[near] = torch.tensor(corrected, dtype=torch.float32, device=distances.device)
    return distances


def _on_processor(side: Side) -> Any:
    if isinstance(side, Tensor):
        return side.cpu().numpy()
    return SubspaceBatch(*(part.cpu().numpy() for part in (side.feet, side.bases)))


def _squares(side: Side) -> Tensor:
    """Squared lengths of points or feet, summed in float64."""
    rows = side if isinstance(side, Tensor) else side.feet
    norms: Tensor = torch.linalg.vector_norm(rows, dim=1, dtype=torch.float64)
    return norms.square().float()


def _on_sphere(side: Side) -> Any:
    """Directions of points; feet and bases times their factors (``exact.spheres``)."""
    if isinstance(side, Tensor):
        return _normalised(side.double(), torch.finfo(torch.float64).tiny).float()
    norms = torch.linalg.vector_norm(side.feet, dim=1, dtype=torch.float64)[:, None]
    radii = (1 - norms.square()).clamp(min=0).sqrt()
    feet = side.feet / norms.clamp(min=1).float()
    return SubspaceTensors(feet, side.bases * radii[:, :, None].float())


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


class _Problem(NamedTuple):
    """Maximise g·u + h·v + uᵀBv over unit u and v, for K pairs."""

    g: Tensor
    h: Tensor
    b: Tensor

    def take(self, index: Tensor) -> Self:
        return type(self)(*(part[index] for part in self))


def _gains(block: Tensor, steps: int) -> Tensor:
    """What the directions add to p·q: ``exact.maximise`` from its two starts."""
    problem = _Problem(block[:, 1:, 0], block[:, 0, 1:], block[:, 1:, 1:].contiguous())
    power = problem.b.mT @ problem.b
    for _ in range(5):
        power = power / power.diagonal(dim1=1, dim2=2).sum(1).clamp(min=_TINY)[:, None, None]
        power = power @ power
    largest = power.diagonal(dim1=1, dim2=2).argmax(dim=1)
    leading = _normalised(power[torch.arange(len(power), device=power.device), :, largest])
    v = torch.stack([leading, -leading], dim=1)
    values = v.new_zeros(v.shape[:2])
    active = torch.arange(len(v), device=v.device)
    value, stepped = _step(problem, v)
    moved, trial = stepped - v, stepped
    for taken in range(1, steps):
        next_value, next_stepped = _step(problem, trial)
        if taken > 1:
            again = torch.nonzero((next_value < value).any(dim=1))[:, 0]
            keep = (next_value[again] >= value[again])[:, :, None]
            trial[again] = torch.where(keep, trial[again], stepped[again])
            next_value[again], next_stepped[again] = _step(problem.take(again), trial[again])
        next_moved = next_stepped - trial
        turn = next_moved - moved
        slope = (next_moved * turn).sum(2) / turn.square().sum(2).clamp(min=_TINY)
        slope = slope.clamp(-LONGEST, LONGEST)[:, :, None]
        value, moved = next_value, next_moved
        trial = _normalised(next_stepped - slope * (next_stepped - stepped))
        stepped = next_stepped
        if taken % 4 == 0:
            done = (moved.square().sum(2) < STILL**2).all(dim=1)
            values[active[done]] = value[done]
            active, problem = active[~done], problem.take(~done)
            value, moved, trial, stepped = (p[~done] for p in (value, moved, trial, stepped))
            if not len(active):
                break
    values[active] = value
    return values.amax(dim=1)


def _step(problem: _Problem, v: Tensor) -> tuple[Tensor, Tensor]:
    """Value at v with the best u, shape (K, S), and the next v, shape (K, S, m_E)."""
    u = v @ problem.b.mT + problem.g[:, None]
    following = _normalised(u) @ problem.b + problem.h[:, None]
    return u.norm(dim=2) + (v @ problem.h[:, :, None])[:, :, 0], _normalised(following)


def _normalised(rows: Tensor, tiny: float = _TINY) -> Tensor:
    """Unit rows along the last axis; a zero row stays zero."""
    norms: Tensor = torch.linalg.vector_norm(rows, dim=-1, keepdim=True)
    return rows / norms.clamp(min=tiny)
