"""Distances of probes to templates: the one entrance to both metrics and both modes.

A probe is a raw descriptor (point to subspace) or itself lifted (subspace to subspace). Probes
and templates may have different subspace dimensions. Float32 runs on compiled kernels (``tiles``)
or, under ``on_device``, on ``torch``; float64 on the plain NumPy of ``exact``, which is their
specification. The kernels' compiler and torch take long to load, so the two are imported where they
are first used.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from templates.distances import exact
from templates.distances.metric import (
    DEFAULT_STEPS,
    Floats,
    Labels,
    Metric,
    Neighbours,
    Progress,
    similarity,
)
from templates.errors import InvalidEmbedding, InvalidTemplate, TemplateError
from templates.space.subspace import SubspaceBatch, is_finite

__all__ = [
    "DEFAULT_STEPS",
    "Labels",
    "Metric",
    "Neighbours",
    "count_within",
    "nearest",
    "on_device",
    "paired_distances",
    "pairwise_distances",
    "require_device",
    "similarity",
    "warm_up",
]

Probes = NDArray[np.float32] | NDArray[np.float64] | SubspaceBatch
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
    """Refuse a device that torch cannot use.

    Raises
    ------
    TemplateError
        There is no torch, or no such device; the message names the remedy.
    """
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
    options = _options(metric, steps, threads)
    probes = _checked(probes, templates, dtype)
    distances: Floats
    device = _DEVICE.get()
    if np.dtype(dtype) == np.float64:
        distances = exact.pairwise(probes, templates, **options)
    elif device is not None:
        torch, *sides = _placed(probes, templates, device)
        distances = torch.pairwise(*sides, **options).cpu().numpy()
    else:
        distances = _tiles().pairwise(probes, templates, threads=threads, **options)
    return distances


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
    progress: Progress | None = None,
) -> Neighbours:
    """Find the K nearest templates of every probe, without the matrix of all distances.

    Parameters
    ----------
    probes, templates, metric, steps, threads
        As of `pairwise_distances`, in float32.
    k : int
        At least 1.
    of_templates
        Find the K nearest probes of every template instead.
    labels : pair of ndarray of int64, shapes (P,) and (T,), optional
        Pairs with equal labels are passed over.
    progress
        Called with numbers of pairs that are done; on a device once, with all of them.

    Returns
    -------
    Neighbours
        Of shape (P, K), or (T, K) with ``of_templates``; the distances are those of
        `pairwise_distances`.

    Raises
    ------
    InvalidEmbedding, InvalidTemplate, TemplateError
        As of `pairwise_distances`.
    """
    options = _options(metric, steps, threads)
    if k < 1:
        raise TemplateError(f"{k} neighbours cannot be found; k is at least 1")
    options |= {"of_templates": of_templates, "labels": _labels(labels, probes, templates)}
    probes = _checked(probes, templates, np.float32)
    device = _DEVICE.get()
    if device is not None:
        torch, *sides = _placed(probes, templates, device)
        neighbours = torch.nearest(*sides, k, **options)
        _report_all(progress, probes, templates)
        return Neighbours(*(part.cpu().numpy() for part in neighbours))
    options |= {"threads": threads, "progress": progress}
    return Neighbours(*_tiles().nearest(probes, templates, k, **options))


def count_within(
    probes: Probes,
    templates: SubspaceBatch,
    thresholds: ArrayLike,
    *,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
    labels: Labels | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> NDArray[np.int64]:
    """Count the pairs up to every threshold, without the matrix of all distances.

    With the labels of people, the counts over the number of pairs of different people are the
    FMR at every threshold.

    Parameters
    ----------
    probes, templates, metric, steps, labels, threads, progress
        As of `nearest`.
    thresholds : array_like of float, shape (S,)
        In any order.

    Returns
    -------
    ndarray of int64, shape (S,)
        Number of pairs with distance <= threshold, of different labels where there are labels.

    Raises
    ------
    InvalidEmbedding, InvalidTemplate, TemplateError
        As of `pairwise_distances`; a threshold that is not a number.
    """
    options = _options(metric, steps, threads)
    limits = np.atleast_1d(np.asarray(thresholds, dtype=np.float64))
    if limits.ndim != 1 or not limits.size or np.isnan(limits).any():
        raise TemplateError("thresholds are a row of numbers")
    options["labels"] = _labels(labels, probes, templates)
    order = np.argsort(limits)
    counts = np.empty(len(limits), dtype=np.int64)
    probes = _checked(probes, templates, np.float32)
    device = _DEVICE.get()
    if device is not None:
        torch, *sides = _placed(probes, templates, device)
        counts[order] = torch.counts_within(*sides, limits[order], **options).cpu().numpy()
        _report_all(progress, probes, templates)
    else:
        options |= {"threads": threads, "progress": progress}
        counts[order] = _tiles().counts_within(probes, templates, limits[order], **options)
    return counts


def paired_distances(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
    dtype: DTypeLike = np.float32,
    as_stored: bool = False,
) -> Floats:
    """Distances of probe i to template i; parameters and errors as in `pairwise_distances`.

    Parameters
    ----------
    as_stored
        Points are compared with templates whose bases are orthonormal to float16 only, as
        ``decode_as_stored`` reads them. Lifted probes need templates of ``decode``.

    Returns
    -------
    ndarray of ``dtype``, shape (P,)
    """
    options = _options(metric, steps)
    probes = _checked(probes, templates, dtype)
    if len(probes) != len(templates):
        raise TemplateError(f"{len(probes)} probes do not pair with {len(templates)} templates")
    if isinstance(probes, SubspaceBatch) and np.dtype(dtype) == np.float32:
        distances: Floats
        device = _DEVICE.get()
        if device is not None:
            torch, *sides = _placed(probes, templates, device)
            distances = torch.paired(*sides, **options).cpu().numpy()
        else:
            distances = _tiles().paired(probes, templates, **options)
        return distances
    every = np.arange(len(probes))
    return exact.pairs(probes, templates, every, every, as_stored=as_stored, **options).astype(
        dtype
    )


def warm_up() -> None:
    """Compile the kernels, or load them from their cache, so that no request has to wait."""
    _tiles().warm_up()


def _report_all(progress: Progress | None, probes: Probes, templates: SubspaceBatch) -> None:
    if progress is not None:
        progress(len(probes) * len(templates))


def _tiles() -> ModuleType:
    from templates.distances import tiles

    return tiles


def _torch() -> ModuleType:
    try:
        from templates.distances import torch
    except ImportError as error:
        raise TemplateError(
            f'{error.name} is not installed, and a device needs it: pip install "veilface[torch]"'
        ) from None
    return torch


def _placed(probes: Probes, templates: SubspaceBatch, device: str) -> tuple[Any, Any, Any]:
    """Load what computes on a device, and copy both sides there."""
    torch = _torch()
    there = torch.usable(device)
    return torch, torch.placed(probes, there), torch.placed(templates, there)


def _options(metric: Metric | str, steps: int, threads: int | None = None) -> dict[str, Any]:
    if threads is not None and threads < 1:
        raise TemplateError(f"there is no work for {threads} threads; at least 1 is needed")
    if steps < 1:
        raise TemplateError(f"the iteration needs at least one step, not {steps}")
    return {"metric": Metric(metric), "steps": steps}


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
