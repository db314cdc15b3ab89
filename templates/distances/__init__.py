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
from numpy.typing import DTypeLike, NDArray

from templates.distances import exact
from templates.distances.metric import (
    DEFAULT_STEPS,
    Floats,
    Labels,
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
    "Labels",
    "Metric",
    "Neighbours",
    "Probes",
    "nearest",
    "on_device",
    "paired_distances",
    "pairwise_distances",
    "require_device",
    "similarity",
    "warm_up",
]

# Pairs that NumPy computes sooner than compiled loops are loaded: what a service compares.
_FEW = 1 << 12
_NOTHING = np.iinfo(np.int64).max
_DEVICE: ContextVar[str | None] = ContextVar("device", default=None)


@contextmanager
def on_device(device: str | None) -> Iterator[None]:
    """Compute the float32 distances of a block on a device of torch, and copy the results back.

    Float64 and pairs of a point and a template (`paired_distances`) stay on the processor. A thread
    that the block starts is outside it, unless it runs in a copy of the context.

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
    dtype: DTypeLike = np.float32,
    threads: int | None = None,
) -> Floats:
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
    dtype : float32 or float64
        Precision of the bulk work. Distances below 0.1 and nearly singular pairs are computed in
        float64 in any case.
    threads : int, optional
        At most; by default as many as the matrix library would use. Their number does not change
        the result. Float64 uses the library's.

    Returns
    -------
    ndarray of ``dtype``, shape (P, T)
        Never NaN and never negative. Memory beyond the result is bounded.

    Raises
    ------
    InvalidEmbedding, InvalidTemplate
        Probes or templates of wrong shape, or with a number that is not finite.
    TemplateError
        A parameter out of range, or a device (`on_device`) that torch cannot use.

    References
    ----------
    Paper eq. 1 to 9; docs/method.md §3.
    """
    probes = _checked(probes, templates, dtype)
    out = np.empty((len(probes), len(templates)), dtype=dtype)
    for rows, columns, distances in _tiles(probes, templates, metric, steps, dtype, threads):
        out[rows, columns] = distances
    return out


def nearest(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    k: int,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
    of_templates: bool = False,
    labels: Labels | None = None,
    threads: int | None = None,
) -> Neighbours:
    """Find the K nearest templates of every probe, without the matrix of all distances.

    Parameters and errors are those of `pairwise_distances`, in float32.

    Parameters
    ----------
    k : int
        At least 1.
    of_templates
        Find the K nearest probes of every template instead.
    labels : pair of ndarray of int64, shapes (P,) and (T,), optional
        Pairs with equal labels are passed over.

    Returns
    -------
    Neighbours
        Of shape (P, K), or (T, K) with ``of_templates``.
    """
    if k < 1:
        raise TemplateError(f"{k} neighbours cannot be found; k is at least 1")
    labels = _labels(labels, probes, templates)
    probes = _checked(probes, templates, np.float32)
    # Of a distance, which is not negative, the bits ascend with it; behind them stands the index.
    best = np.full((len(templates if of_templates else probes), k), _NOTHING)
    for rows, columns, distances in _tiles(probes, templates, metric, steps, np.float32, threads):
        keys = np.ascontiguousarray(distances, dtype=np.float32).view(np.int32).astype(np.int64)
        keys <<= 32
        if labels is not None:
            keys[labels[0][rows, None] == labels[1][columns]] = _NOTHING
        if of_templates:
            rows, columns, keys = columns, rows, keys.T
        keys = np.concatenate([best[rows], keys | np.arange(columns.start, columns.stop)], axis=1)
        best[rows] = np.partition(keys, k - 1, axis=1)[:, :k]
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
    dtype: DTypeLike = np.float32,
    as_stored: bool = False,
) -> Floats:
    """Distances of probe i to template i, computed in float64 whatever ``dtype`` is.

    Under `on_device`, float32 distances of lifted probes are computed there. Parameters and errors
    are those of `pairwise_distances`.

    Parameters
    ----------
    as_stored
        Points are compared with templates whose bases are orthonormal to float16 only, as
        ``decode_as_stored`` reads them. Lifted probes need templates of ``decode``.

    Returns
    -------
    ndarray of ``dtype``, shape (P,)
    """
    metric = _metric(metric, steps)
    probes = _checked(probes, templates, dtype)
    if len(probes) != len(templates):
        raise TemplateError(f"{len(probes)} probes do not pair with {len(templates)} templates")
    device = None if np.dtype(dtype) == np.float64 else _DEVICE.get()
    if device is not None and isinstance(probes, SubspaceBatch):
        distances: Floats = _torch().paired(
            probes, templates, metric=metric, steps=steps, device=device
        )
        return distances
    every = np.arange(len(probes))
    return exact.pairs(
        probes, templates, every, every, metric=metric, steps=steps, as_stored=as_stored
    ).astype(dtype)


def warm_up() -> None:
    """Compile the loops of the extra ``evaluate``, or load them; a TemplateError without numba."""
    compiled = _compiled()
    if compiled is None:
        raise TemplateError(
            'numba is not installed, and fast distances need it: pip install "veilface[evaluate]"'
        )
    axes = np.eye(3, dtype=np.float32)
    batch = SubspaceBatch(0.5 * axes[:1], axes[None, 1:2])
    for metric in Metric:
        for probes in (axes, batch):
            list(compiled.tiles(probes, batch, metric=metric, steps=2, threads=1))


def _tiles(
    probes: Probes,
    templates: SubspaceBatch,
    metric: Metric | str,
    steps: int,
    dtype: DTypeLike,
    threads: int | None,
) -> Iterator[Tile]:
    """Choose who computes, and yield rows, columns and distances of all parts of the matrix."""
    metric = _metric(metric, steps)
    if threads is not None and threads < 1:
        raise TemplateError(f"there is no work for {threads} threads; at least 1 is needed")
    device = None if np.dtype(dtype) == np.float64 else _DEVICE.get()
    if device is not None:
        of_device: Iterator[Tile] = _torch().tiles(
            probes, templates, metric=metric, steps=steps, device=device
        )
        return of_device
    compiled = None
    if np.dtype(dtype) == np.float32 and len(probes) * len(templates) > _FEW:
        compiled = _compiled()
    if compiled is None:
        parts = exact.tiles(probes, templates, metric=metric, steps=steps, dtype=dtype)
        return ((rows, columns, part.astype(dtype)) for rows, columns, part in parts)
    of_loops: Iterator[Tile] = compiled.tiles(
        probes, templates, metric=metric, steps=steps, threads=threads
    )
    return of_loops


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


def _metric(metric: Metric | str, steps: int) -> Metric:
    if steps < 1:
        raise TemplateError(f"the iteration needs at least one step, not {steps}")
    return Metric(metric)


def _checked(probes: Any, templates: SubspaceBatch, dtype: DTypeLike) -> Probes:
    kind = np.dtype(dtype)
    if kind not in (np.float32, np.float64):
        raise TemplateError(f"distances are computed in float32 or float64, not {kind}")
    _check_finite(templates)
    if isinstance(probes, SubspaceBatch):
        if probes.n != templates.n:
            raise InvalidTemplate(
                f"a probe in R^{probes.n} does not fit templates in R^{templates.n}"
            )
        _check_finite(probes)
        return probes
    if not isinstance(probes, np.ndarray):
        raise TemplateError("probes are an array or a batch")
    if probes.ndim != 2 or probes.shape[1] != templates.n:
        raise InvalidEmbedding(f"expected probes of shape (P, {templates.n}), seen {probes.shape}")
    # What is infinite in the precision of the work is refused.
    with np.errstate(over="ignore", invalid="ignore"):
        points: NDArray[Any] = np.ascontiguousarray(probes, dtype=kind)
    if not is_finite(points):
        raise InvalidEmbedding("a probe holds a number that is not finite")
    return points


def _check_finite(batch: SubspaceBatch) -> None:
    if not batch.is_finite:
        raise InvalidTemplate("a template holds a number that is not finite")


def _labels(labels: Labels | None, probes: Any, templates: Any) -> Labels | None:
    if labels is None:
        return None
    given = [np.asarray(side) for side in labels]
    if any(side.dtype.kind not in "iub" for side in given):
        raise TemplateError("labels are whole numbers; number the names, as np.unique does")
    left, right = (np.array(side, dtype=np.int64) for side in given)
    if left.shape != (len(probes),) or right.shape != (len(templates),):
        raise TemplateError(
            f"labels of shapes {left.shape} and {right.shape} do not fit {len(probes)} probes "
            f"and {len(templates)} templates"
        )
    return left, right
