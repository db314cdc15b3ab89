"""Distances of probes to templates: the one entrance to both metrics and both modes.

A probe is a raw descriptor (point to subspace) or itself lifted (subspace to subspace). Probes
and templates may have different subspace dimensions. Float32 runs on compiled kernels
(``templates.distances.tiles``) or, on a device, on torch (``templates.distances.tensors``); float64 on the plain NumPy
of ``templates.distances.euclidean`` and ``templates.distances.spherical``, which is their specification.
"""

from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from templates.distances import euclidean, spherical
from templates.distances.crossgram import Kind
from templates.distances.metric import DEFAULT_STEPS, Floats, Labels, Metric, Neighbours
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

if TYPE_CHECKING:
    from torch import Tensor

    from templates.distances.tensors import SubspaceTensors

Progress = Callable[[int], None]

Probes = NDArray[np.float32] | NDArray[np.float64] | SubspaceBatch


@overload
def pairwise_distances(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric | str,
    steps: int = ...,
    dtype: DTypeLike = ...,
    threads: int | None = ...,
    device: str | None = ...,
) -> Floats: ...


@overload
def pairwise_distances(
    probes: "Tensor | SubspaceTensors",
    templates: "SubspaceTensors",
    *,
    metric: Metric | str,
    steps: int = ...,
) -> "Tensor": ...


def pairwise_distances(
    probes: "Probes | Tensor | SubspaceTensors",
    templates: "SubspaceBatch | SubspaceTensors",
    *,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
    dtype: DTypeLike = np.float32,
    threads: int | None = None,
    device: str | None = None,
) -> "Floats | Tensor":
    """Distances of every probe to every template.

    Parameters
    ----------
    probes : ndarray of float, shape (P, n), or SubspaceBatch of P
        Raw descriptors or lifted probes. The spherical metric sees only the direction of a raw
        descriptor; a zero vector has similarity 0.
    templates : SubspaceBatch of T
        Or SubspaceTensors, with probes that are tensors: all stays on their device.
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
        Never NaN and never negative. Memory beyond the result is bounded. A Tensor where
        templates are tensors.

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
    metric = Metric(metric)
    _check_options(steps, threads)
    if device is not None or not isinstance(templates, SubspaceBatch):
        if np.dtype(dtype) != np.float32:
            raise TemplateError(f"a device computes in float32, not in {np.dtype(dtype)}")
        found = _tensors().pairwise(probes, templates, metric=metric, steps=steps, device=device)
        result: Floats = found.cpu().numpy() if isinstance(templates, SubspaceBatch) else found
        return result
    probes, kind = _checked(probes, templates, dtype)
    out = np.empty((len(probes), len(templates)), dtype=kind)
    if out.size and kind == np.float64:
        return _reference(probes, templates, metric, steps)
    if out.size:
        _tiles().matrix(probes, templates, out, metric=metric, steps=steps, threads=threads)
    return out


def nearest(
    probes: "Probes | Tensor | SubspaceTensors",
    templates: "SubspaceBatch | SubspaceTensors",
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
        `pairwise_distances`. Tensors where templates are tensors.

    Raises
    ------
    InvalidEmbedding, InvalidTemplate, TemplateError
        As of `pairwise_distances`.
    """
    metric = Metric(metric)
    if k < 1:
        raise TemplateError(f"{k} neighbours cannot be found; k is at least 1")
    _check_options(steps, threads)
    labels = _labels(labels, len(probes), len(templates))
    if device is not None or not isinstance(templates, SubspaceBatch):
        options: dict[str, Any] = {"k": k, "metric": metric, "steps": steps, "device": device}
        found = _tensors().nearest(
            probes, templates, of_templates=of_templates, labels=labels, **options
        )
        if isinstance(templates, SubspaceBatch):
            return Neighbours(*(part.cpu().numpy() for part in found))
        return Neighbours(*found)
    probes, _ = _checked(probes, templates, np.float32)
    return Neighbours(
        *_tiles().nearest(
            probes,
            templates,
            k,
            of_templates=of_templates,
            labels=labels,
            metric=metric,
            steps=steps,
            threads=threads,
            progress=progress,
        )
    )


def count_within(
    probes: "Probes | Tensor | SubspaceTensors",
    templates: "SubspaceBatch | SubspaceTensors",
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
    metric = Metric(metric)
    limits = np.atleast_1d(np.asarray(thresholds, dtype=np.float64))
    if limits.ndim != 1 or not limits.size or np.isnan(limits).any():
        raise TemplateError("thresholds are a row of numbers")
    _check_options(steps, threads)
    labels = _labels(labels, len(probes), len(templates))
    order = np.argsort(limits)
    counts = np.empty(len(limits), dtype=np.int64)
    if device is not None or not isinstance(templates, SubspaceBatch):
        options: dict[str, Any] = {"metric": metric, "steps": steps, "device": device}
        found = _tensors().counts_within(probes, templates, limits[order], labels=labels, **options)
        counts[order] = found.cpu().numpy()
        return counts
    probes, _ = _checked(probes, templates, np.float32)
    counts[order] = _tiles().counts(
        probes,
        templates,
        limits[order],
        labels=labels,
        metric=metric,
        steps=steps,
        threads=threads,
        progress=progress,
    )
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
    metric = Metric(metric)
    _check_options(steps, None)
    probes, kind = _checked(probes, templates, dtype)
    if len(probes) != len(templates):
        raise TemplateError(f"{len(probes)} probes do not pair with {len(templates)} templates")
    if not len(probes):
        return np.empty(0, dtype=kind)
    if isinstance(probes, SubspaceBatch):
        if kind == np.float32:
            found: Floats = _tiles().paired(probes, templates, metric=metric, steps=steps)
            return found
        if metric is Metric.EUCLIDEAN:
            return euclidean.subspaces_paired(probes, templates, kind)
        return spherical.subspaces_paired(probes, templates, steps, kind)
    points = np.ascontiguousarray(probes, dtype=kind)
    if metric is Metric.EUCLIDEAN:
        return euclidean.points_paired(points, templates, kind)
    return spherical.points_paired(points, templates, kind)


def warm_up() -> None:
    """Compile the kernels, or load them from their cache, so that no request has to wait."""
    _tiles().warm_up()


@overload
def similarity(distance: float) -> float: ...


@overload
def similarity(distance: NDArray[np.floating]) -> NDArray[np.floating]: ...


def similarity(distance: float | NDArray[np.floating]) -> float | NDArray[np.floating]:
    """Return 1 − distance²/2: the cosine on the unit sphere, and one scale for both metrics."""
    return 1 - distance**2 / 2


def _check_options(steps: int, threads: int | None) -> None:
    if threads is not None and threads < 1:
        raise TemplateError(f"there is no work for {threads} threads; at least 1 is needed")
    if steps < 1:
        raise TemplateError(f"the iteration needs at least one step, not {steps}")


def _checked(probes: Any, templates: SubspaceBatch, dtype: DTypeLike) -> tuple[Probes, Kind]:
    kind: Kind = np.dtype(np.float64 if np.dtype(dtype) == np.float64 else np.float32)
    if np.dtype(dtype) != kind:
        raise TemplateError(f"distances are computed in float32 or float64, not {np.dtype(dtype)}")
    _check_finite(templates)
    if isinstance(probes, SubspaceBatch):
        if probes.n != templates.n:
            raise InvalidTemplate(
                f"a probe in R^{probes.n} does not fit templates in R^{templates.n}"
            )
        _check_finite(probes)
        return probes, kind
    if not isinstance(probes, np.ndarray):
        raise TemplateError("probes are arrays or a batch where templates are a batch")
    if probes.ndim != 2 or probes.shape[1] != templates.n:
        raise InvalidEmbedding(f"expected probes of shape (P, {templates.n}), seen {probes.shape}")
    # What is infinite in the precision of the work is refused.
    with np.errstate(over="ignore", invalid="ignore"):
        probes = np.ascontiguousarray(probes, dtype=kind)
    if not is_finite(probes):
        raise InvalidEmbedding("a probe holds a number that is not finite")
    return probes, kind


def _check_finite(batch: SubspaceBatch) -> None:
    if not batch.is_finite:
        raise InvalidTemplate("a template holds a number that is not finite")


def _tiles() -> ModuleType:
    """The compiled kernels, imported when they are needed: the compiler takes a while to load."""
    from templates.distances import bulk

    return bulk


def _tensors() -> ModuleType:
    try:
        from templates.distances import tensors
    except ImportError as error:
        raise TemplateError(
            f"a device needs the extra 'torch' of veilface ({error.name} is not installed)"
        ) from None
    return tensors


def _reference(probes: Probes, templates: SubspaceBatch, metric: Metric, steps: int) -> Floats:
    kind: Kind = np.dtype(np.float64)
    if isinstance(probes, SubspaceBatch):
        if metric is Metric.EUCLIDEAN:
            return euclidean.subspaces_pairwise(probes, templates, kind)
        return spherical.subspaces_pairwise(probes, templates, steps, kind)
    points = np.ascontiguousarray(probes, dtype=kind)
    if metric is Metric.EUCLIDEAN:
        return euclidean.points_pairwise(points, templates, kind)
    return spherical.points_pairwise(points, templates, kind)


def _labels(labels: Labels | None, probes: int, templates: int) -> Labels | None:
    if labels is None:
        return None
    given = [np.asarray(side) for side in labels]
    if any(side.dtype.kind not in "iub" for side in given):
        raise TemplateError("labels are whole numbers; number the names, as np.unique does")
    mine, theirs = (np.array(side, dtype=np.int64) for side in given)
    if mine.shape != (probes,) or theirs.shape != (templates,):
        raise TemplateError(
            f"labels of shapes {mine.shape} and {theirs.shape} do not fit {probes} probes "
            f"and {templates} templates"
        )
    return mine, theirs
