"""All pairs of probes and templates on a device, a tile at a time.

Memory beyond the result is bounded by the tile, whatever the number of pairs. Products are float32
proper, and no operation leaves the order of its sums to chance.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from templates.distances.metric import DEFAULT_STEPS, Metric
from templates.distances.tensors import euclidean, spherical
from templates.distances.tensors.edge import place
from templates.distances.tensors.subspaces import SubspaceTensors, ieee_products, tile_bytes

Probes = Tensor | SubspaceTensors
Labels = tuple[Tensor, Tensor]

# No pair: behind every distance, and behind the index of every template.
_NOTHING = torch.iinfo(torch.int64).max


def pairwise(
    probes: Probes,
    templates: SubspaceTensors,
    *,
    metric: Metric,
    steps: int = DEFAULT_STEPS,
    device: str | None = None,
) -> Tensor:
    """Distances of every probe to every template.

    Parameters
    ----------
    probes : Tensor of float32, shape (P, n), or SubspaceTensors of P
        Raw descriptors or lifted probes, on the templates' device, finite.
    templates : SubspaceTensors of T
    metric : Metric
    steps : int
        Of the spherical subspace-to-subspace iteration; unused otherwise.
    device : str, optional
        Arrays and batches are brought there; tensors stay where they are.

    Returns
    -------
    Tensor of float32, shape (P, T), on the same device
        Never NaN and never negative.

    Notes
    -----
    The bulk is float32; distances below 0.1, nearly singular pairs and whatever overflows are
    computed again in float64. Shown to be correct on the CPU, and its kernels in Triton's
    interpreter; ``benchmarks/gpu_distances.py`` measures it on a GPU.

    References
    ----------
    Paper eq. 1 to 9; docs/method.md §3 and §5.
    """
    probes, templates = place(probes, templates, device)
    out = torch.empty(len(probes), len(templates), device=templates.device)
    with ieee_products(templates.device):
        for rows, columns, distances in _tiles(probes, templates, metric, steps):
            out[rows, columns] = distances
    return out


def nearest(
    probes: Probes,
    templates: SubspaceTensors,
    *,
    k: int,
    metric: Metric,
    steps: int = DEFAULT_STEPS,
    of_templates: bool = False,
    labels: Labels | None = None,
    device: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the k nearest templates of every probe, without the matrix of all distances.

    Parameters
    ----------
    probes, templates, metric, steps, device
        As of `pairwise`.
    k : int
        At least 1.
    of_templates : bool
        Find the nearest probes of every template instead.
    labels : pair of Tensor of integers, shapes (P,) and (T,), optional
        Pairs with equal labels are left out.

    Returns
    -------
    indices : Tensor of int64, shape (P, k)
        Nearest first; of equal distances the lowest index first. −1 where fewer than k templates
        are left.
    distances : Tensor of float32, shape (P, k)
        Infinite where the index is −1.
    """
    probes, templates = place(probes, templates, device)
    there = templates.device
    best = torch.full((len(templates if of_templates else probes), k), _NOTHING, device=there)
    labels = _placed(labels, there)
    if labels is not None and of_templates:
        labels = labels[::-1]
    with ieee_products(there):
        for rows, columns, distances in _tiles(probes, templates, metric, steps):
            if of_templates:
                rows, columns, distances = columns, rows, distances.T
            # A distance is not negative, so its bits ascend with it.
            keys = distances.abs().contiguous().view(torch.int32).long() << 32
            keys += torch.arange(columns.start, columns.stop, device=there)
            if labels is not None:
                keys[_same(labels, rows, columns)] = _NOTHING
            keys = torch.cat([best[rows], keys], dim=1)
            best[rows] = torch.topk(keys, k, dim=1, largest=False).values
    nothing = best == _NOTHING
    found = (best >> 32).int().view(torch.float32)
    return (
        (best & 0xFFFFFFFF).masked_fill_(nothing, -1),
        found.masked_fill(nothing, torch.inf),
    )


def counts_within(
    probes: Probes,
    templates: SubspaceTensors,
    thresholds: NDArray[np.float64],
    *,
    metric: Metric,
    steps: int = DEFAULT_STEPS,
    labels: Labels | None = None,
    device: str | None = None,
) -> Tensor:
    """Count the pairs up to each threshold, without the matrix of all distances.

    Parameters
    ----------
    probes, templates, metric, steps, labels, device
        As of `nearest`.
    thresholds : ndarray of float64, shape (L,)
        Ascending.

    Returns
    -------
    Tensor of int64, shape (L,), on the templates' device
        Number of pairs with distance <= threshold.
    """
    probes, templates = place(probes, templates, device)
    labels = _placed(labels, templates.device)
    bounds = torch.tensor(thresholds, dtype=torch.float64, device=templates.device)
    counts = torch.zeros(len(bounds) + 1, dtype=torch.int64, device=templates.device)
    with ieee_products(templates.device):
        for rows, columns, distances in _tiles(probes, templates, metric, steps):
            places = torch.searchsorted(bounds, distances.double().contiguous())
            if labels is not None:
                places[_same(labels, rows, columns)] = len(bounds)
            counts += torch.bincount(places.flatten(), minlength=len(counts))
    return counts[:-1].cumsum(0)


def _tiles(
    probes: Probes, templates: SubspaceTensors, metric: Metric, steps: int
) -> Iterator[tuple[slice, slice, Tensor]]:
    """Yield rows, columns and their distances, the columns of one row of tiles in order."""
    metric = Metric(metric)
    rows, columns = len(probes), len(templates)
    budget = tile_bytes(templates.device) // 4
    deep = 1 if isinstance(probes, Tensor) else probes.m + 1
    wide = templates.m + 1
    pairs = max(1, budget // (deep * wide))
    # The stacked rows count too: few probes and many templates must not make a long tile.
    height = min(rows, math.isqrt(pairs), max(1, budget // (deep * templates.n)))
    width = min(columns, pairs // max(1, height), max(1, budget // (wide * templates.n)))
    for row in range(0, rows, max(1, height)):
        for column in range(0, columns, max(1, width)):
            part = slice(row, min(row + height, rows)), slice(column, min(column + width, columns))
            yield *part, _distances(probes[part[0]], templates[part[1]], metric, steps)


def _distances(probes: Probes, templates: SubspaceTensors, metric: Metric, steps: int) -> Tensor:
    """Distances of one tile, shape (P, T)."""
    if isinstance(probes, Tensor):
        if metric is Metric.EUCLIDEAN:
            return euclidean.points(probes, templates)
        return spherical.points(probes, templates)
    if probes.m < templates.m:
        return _distances(templates, probes, metric, steps).T
    if metric is Metric.EUCLIDEAN:
        return euclidean.subspaces(probes, templates)
    return spherical.subspaces(probes, templates, steps)


def _placed(labels: Labels | None, device: torch.device) -> Labels | None:
    if labels is None:
        return None
    return torch.as_tensor(labels[0], device=device), torch.as_tensor(labels[1], device=device)


def _same(labels: Labels, rows: slice, columns: slice) -> Tensor:
    return labels[0][rows, None] == labels[1][columns]
