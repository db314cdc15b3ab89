"""Distances of probes to templates: the one entrance to both metrics and both modes.

A probe is a raw descriptor (point to subspace) or itself lifted (subspace to subspace). Probes
and templates may have different subspace dimensions. Float32 runs on compiled kernels (``tiles``)
or, on a device, on ``torch``; float64 on the plain NumPy of ``exact``, which is their
specification. The kernels' compiler and torch take long to load, so the two are imported where they
are first used.
"""

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
    "paired_distances",
    "pairwise_distances",
    "similarity",
    "warm_up",
]

Probes = NDArray[np.float32] | NDArray[np.float64] | SubspaceBatch


def pairwise_distances(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
    dtype: DTypeLike = np.float32,
    threads: int | None = None,
    device: str | None = None,
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
    device : str, optional
        Of torch, such as "cuda": the float32 work is done there, and the result copied back.

    Returns
    -------
    ndarray of ``dtype``, shape (P, T)
        Never NaN and never negative. Memory beyond the result is bounded.

    Raises
    ------
    InvalidEmbedding, InvalidTemplate
        Probes or templates of wrong shape, or with a number that is not finite.
    TemplateError
        A parameter out of range, or a device that torch cannot use.

    References
    ----------
    Paper eq. 1 to 9; docs/method.md §3 and §5.
    """
    options = _options(metric, steps, threads)
    probes = _checked(probes, templates, dtype)
    found: Floats
    if device is not None:
        if np.dtype(dtype) != np.float32:
            raise TemplateError(f"a device computes in float32, not in {np.dtype(dtype)}")
        found = _torch().pairwise(probes, templates, device=device, **options).cpu().numpy()
    elif np.dtype(dtype) == np.float64:
        found = exact.pairwise(probes, templates, **options)
    else:
        found = _tiles().pairwise(probes, templates, threads=threads, **options)
    return found


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
    device: str | None = None,
    progress: Progress | None = None,
) -> Neighbours:
    """Find the K nearest templates of every probe, without the matrix of all distances.

    Parameters
    ----------
    probes, templates, metric, steps, threads, device
        As of `pairwise_distances`, in float32.
    k : int
        At least 1.
    of_templates
        Find the K nearest probes of every template instead.
    labels : pair of ndarray of int64, shapes (P,) and (T,), optional
        Pairs with equal labels are passed over.
    progress
        Called with numbers of pairs that are done; not called on a device.

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
    if device is not None:
        found = _torch().nearest(probes, templates, k, device=device, **options)
        return Neighbours(*(part.cpu().numpy() for part in found))
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
    device: str | None = None,
    progress: Progress | None = None,
) -> NDArray[np.int64]:
    """Count the pairs up to every threshold, without the matrix of all distances.

    With the labels of people, the counts over the number of pairs of different people are the
    FMR at every threshold.

    Parameters
    ----------
    probes, templates, metric, steps, labels, threads, device, progress
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
    if device is not None:
        found = _torch().counts_within(probes, templates, limits[order], device=device, **options)
        counts[order] = found.cpu().numpy()
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
) -> Floats:
    """Distances of probe i to template i; parameters and errors as in `pairwise_distances`.

    Returns
    -------
    ndarray of ``dtype``, shape (P,)
    """
    options = _options(metric, steps)
    probes = _checked(probes, templates, dtype)
    if len(probes) != len(templates):
        raise TemplateError(f"{len(probes)} probes do not pair with {len(templates)} templates")
    if isinstance(probes, SubspaceBatch) and np.dtype(dtype) == np.float32:
        found: Floats = _tiles().paired(probes, templates, **options)
        return found
    every = np.arange(len(probes))
    return exact.pairs(probes, templates, every, every, **options).astype(dtype)


def warm_up() -> None:
    """Compile the kernels, or load them from their cache, so that no request has to wait."""
    _tiles().warm_up()


def _tiles() -> ModuleType:
    from templates.distances import tiles

    return tiles


def _torch() -> ModuleType:
    try:
        from templates.distances import torch
    except ImportError as error:
        raise TemplateError(
            f"a device needs the extra 'torch' of veilface ({error.name} is not installed)"
        ) from None
    return torch


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
