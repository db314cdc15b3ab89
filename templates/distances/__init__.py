"""Distances of probes to templates: the one entrance to both metrics and both modes.

A probe is a raw embedding (point to subspace) or itself lifted (subspace to subspace). Probes and
templates may have different subspace dimensions. Three files compute the parts of a matrix:
``exact`` in NumPy and float64, which is the specification and all that a service needs;
``compiled`` in float32 (extra ``evaluate``), where there are more than some thousand pairs; and
``torch`` in float32, under ``on_device``. The last two are imported where they are first used.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from templates.distances import exact
from templates.distances.metric import (
    DEFAULT_STEPS,
    Array32,
    Metric,
    Neighbours,
    Probes,
    Tile,
    similarity,
)
from templates.errors import InvalidEmbedding, InvalidTemplate, TemplateError
from templates.space.subspace import SubspaceBatch, is_finite

__all__ = [
    "DEFAULT_STEPS",
    "Metric",
    "Neighbours",
    "Probes",
    "nearest",
    "on_device",
    "paired_distances",
    "pairwise_distances",
    "require_device",
    "similarity",
]

# Pairs that NumPy computes sooner than compiled loops are loaded: what a service compares.
_FEW = 1 << 12
_NOTHING = np.iinfo(np.int64).max
_DEVICE: ContextVar[str | None] = ContextVar("device", default=None)


@contextmanager
def on_device(device: str | None) -> Iterator[None]:
    """Compute the distances of a block on a device of torch, and copy the results back.

    `paired_distances` stay on the processor. A thread that the block starts is outside it, unless
    it runs in a copy of the context.

    Parameters
    ----------
    device : str, optional
        As torch names it, such as "cuda"; None for the processor without torch. One that torch
        cannot use is a TemplateError of the first call that needs it.

    Examples
    --------
    >>> with on_device("cuda"):  # doctest: +SKIP
    ...     pairwise_distances(probes, templates, metric="spherical")
    """
    before = _DEVICE.set(device)
    try:
        yield
    finally:
        _DEVICE.reset(before)


def require_device(device: str) -> None:
    """Refuse a device that torch cannot use with a TemplateError, which names the remedy."""
    _torch().usable(device)


def pairwise_distances(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
) -> Array32:
    """Distances of every probe to every template.

    Parameters
    ----------
    probes : ndarray of float, shape (P, n), or SubspaceBatch of P
        Raw descriptors or lifted probes. The spherical metric sees only the direction of a raw
        descriptor; a zero vector has similarity 0.
    templates : SubspaceBatch of T
    metric : Metric
    steps : int
        Of the spherical subspace-to-subspace iteration; unused otherwise.

    Returns
    -------
    ndarray of float32, shape (P, T)
        Never NaN and never negative. Distances below 0.1 and nearly singular pairs are computed in
        float64. Memory beyond the result is bounded.

    Raises
    ------
    InvalidEmbedding, InvalidTemplate
        Probes or templates of wrong shape, or with a number that is not finite.
    TemplateError
        Fewer than one step, or a device (`on_device`) that torch cannot use.

    References
    ----------
    Paper eq. 1 to 9; docs/method.md §3.
    """
    probes = _checked(probes, templates, steps)
    out = np.empty((len(probes), len(templates)), dtype=np.float32)
    for rows, columns, distances in _tiles(probes, templates, Metric(metric), steps):
        out[rows, columns] = distances
    return out


def nearest(
    points: NDArray[np.floating[Any]], templates: SubspaceBatch, *, k: int, metric: Metric | str
) -> Neighbours:
    """Find the K points nearest to every template, without the matrix of all distances.

    Parameters and errors are those of `pairwise_distances`; k is at least 1.

    Returns
    -------
    Neighbours
        Of shape (T, K).
    """
    if k < 1:
        raise TemplateError(f"{k} neighbours cannot be found; k is at least 1")
    probes = _checked(points, templates)
    # Of a distance, which is not negative, the bits ascend with it; behind them stands the index.
    best = np.full((len(templates), k), _NOTHING)
    for rows, columns, distances in _tiles(probes, templates, Metric(metric), DEFAULT_STEPS):
        bits = np.ascontiguousarray(distances.T, dtype=np.float32).view(np.int32)
        keys = bits.astype(np.int64) << 32 | np.arange(rows.start, rows.stop)
        keys = np.concatenate([best[columns], keys], axis=1)
        best[columns] = np.partition(keys, k - 1, axis=1)[:, :k]
    best.sort(axis=1)
    nothing = best == _NOTHING
    nearby = (best >> 32).astype(np.int32).view(np.float32)
    return Neighbours(np.where(nothing, -1, best & 0xFFFFFFFF), np.where(nothing, np.inf, nearby))


def paired_distances(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
    as_stored: bool = False,
) -> Array32:
    """Distances of probe i to template i, computed in float64.

    Parameters and errors are those of `pairwise_distances`.

    Parameters
    ----------
    as_stored
        Points are compared with templates whose bases are orthonormal to float16 only, as
        ``decode_as_stored`` reads them. Lifted probes need templates of ``decode``.

    Returns
    -------
    ndarray of float32, shape (P,)
    """
    probes = _checked(probes, templates, steps)
    if len(probes) != len(templates):
        raise TemplateError(f"{len(probes)} probes do not pair with {len(templates)} templates")
    every = np.arange(len(probes))
    return exact.pairs(
        probes, templates, every, every, metric=Metric(metric), steps=steps, as_stored=as_stored
    ).astype(np.float32)


def _tiles(probes: Probes, templates: SubspaceBatch, metric: Metric, steps: int) -> Iterator[Tile]:
    """Choose who computes, and yield rows, columns and distances of all parts of the matrix."""
    options: dict[str, Any] = {"metric": metric, "steps": steps}
    computing: ModuleType = exact
    if (device := _DEVICE.get()) is not None:
        computing, options["device"] = _torch(), device
    elif len(probes) * len(templates) > _FEW:
        computing = _compiled() or exact
    if computing is exact:
        options["dtype"] = np.float32
    tiles: Iterator[Tile] = computing.tiles(probes, templates, **options)
    return tiles


def _compiled() -> ModuleType | None:
    """Load the compiled loops; without the extra there are none, and NumPy gives the same."""
    try:
        from templates.distances import compiled
    except ImportError:
        return None
    return compiled


def _torch() -> ModuleType:
    try:
        from templates.distances import torch
    except ImportError as error:
        raise TemplateError(
            f'{error.name} is not installed, and a device needs it: pip install "veilface[torch]"'
        ) from None
    return torch


def _checked(probes: Any, templates: SubspaceBatch, steps: int = DEFAULT_STEPS) -> Probes:
    if steps < 1:
        raise TemplateError(f"the iteration needs at least one step, not {steps}")
    _check_finite(templates)
    if isinstance(probes, SubspaceBatch):
        if probes.n != templates.n:
            raise InvalidTemplate(
                f"a probe in R^{probes.n} does not fit templates in R^{templates.n}"
            )
        _check_finite(probes)
        return probes
    if probes.ndim != 2 or probes.shape[1] != templates.n:
        raise InvalidEmbedding(f"expected probes of shape (P, {templates.n}), seen {probes.shape}")
    # What is infinite in float32 is refused.
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.ascontiguousarray(probes, dtype=np.float32)
    if not is_finite(points):
        raise InvalidEmbedding("a probe holds a number that is not finite")
    return points


def _check_finite(batch: SubspaceBatch) -> None:
    if not batch.is_finite:
        raise InvalidTemplate("a template holds a number that is not finite")
