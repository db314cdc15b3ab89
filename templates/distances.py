"""Distances of probes to templates: the one entrance to both metrics and both modes.

A probe is a raw descriptor (point to subspace) or itself lifted (subspace to subspace). Probes
and templates may have different subspace dimensions.
"""

from enum import StrEnum
from typing import overload

import numpy as np
from numpy.typing import DTypeLike, NDArray

from templates import euclidean, spherical
from templates.crossgram import Floats, Kind
from templates.errors import InvalidEmbedding, InvalidTemplate, TemplateError
from templates.subspace import SubspaceBatch

DEFAULT_STEPS = 50
"""Steps of the spherical subspace-to-subspace iteration; part of a calibration."""

Probes = NDArray[np.float32] | NDArray[np.float64] | SubspaceBatch


class Metric(StrEnum):
    """Which closest points count."""

    EUCLIDEAN = "euclidean"
    """Any of the subspace: the paper's distances."""
    SPHERICAL = "spherical"
    """Those of unit length, as every descriptor is: what the product decides with."""


def pairwise_distances(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric | str,
    steps: int = DEFAULT_STEPS,
    dtype: DTypeLike = np.float32,
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

    Returns
    -------
    ndarray of ``dtype``, shape (P, T)
        Never NaN and never negative. Memory beyond the result is bounded.

    Raises
    ------
    InvalidEmbedding, InvalidTemplate
        Probes or templates of wrong shape, or with a number that is not finite.

    References
    ----------
    Paper eq. 1 to 9; METHOD §3.
    """
    metric, kind = Metric(metric), _checked(probes, templates, steps, dtype)
    shape = (len(probes), len(templates))
    if 0 in shape:
        return np.empty(shape, dtype=kind)
    if isinstance(probes, SubspaceBatch):
        if metric is Metric.EUCLIDEAN:
            return euclidean.subspaces_pairwise(probes, templates, kind)
        return spherical.subspaces_pairwise(probes, templates, steps, kind)
    points = np.ascontiguousarray(probes, dtype=kind)
    if metric is Metric.EUCLIDEAN:
        return euclidean.points_pairwise(points, templates, kind)
    return spherical.points_pairwise(points, templates, kind)


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
    metric, kind = Metric(metric), _checked(probes, templates, steps, dtype)
    if len(probes) != len(templates):
        raise TemplateError(f"{len(probes)} probes do not pair with {len(templates)} templates")
    if not len(probes):
        return np.empty(0, dtype=kind)
    if isinstance(probes, SubspaceBatch):
        if metric is Metric.EUCLIDEAN:
            return euclidean.subspaces_paired(probes, templates, kind)
        return spherical.subspaces_paired(probes, templates, steps, kind)
    points = np.ascontiguousarray(probes, dtype=kind)
    if metric is Metric.EUCLIDEAN:
        return euclidean.points_paired(points, templates, kind)
    return spherical.points_paired(points, templates, kind)


@overload
def similarity(distance: float) -> float: ...


@overload
def similarity(distance: NDArray[np.floating]) -> NDArray[np.floating]: ...


def similarity(distance: float | NDArray[np.floating]) -> float | NDArray[np.floating]:
    """Return 1 − distance²/2: the cosine on the unit sphere, and one scale for both metrics."""
    return 1 - distance**2 / 2


def _checked(probes: Probes, templates: SubspaceBatch, steps: int, dtype: DTypeLike) -> Kind:
    kind: Kind = np.dtype(np.float64 if np.dtype(dtype) == np.float64 else np.float32)
    if np.dtype(dtype) != kind:
        raise TemplateError(f"distances are computed in float32 or float64, not {np.dtype(dtype)}")
    if steps < 1:
        raise TemplateError(f"the iteration needs at least one step, not {steps}")
    _check_finite(templates)
    if isinstance(probes, SubspaceBatch):
        if probes.n != templates.n:
            raise InvalidTemplate(
                f"a probe in R^{probes.n} does not fit templates in R^{templates.n}"
            )
        _check_finite(probes)
        return kind
    if probes.ndim != 2 or probes.shape[1] != templates.n:
        raise InvalidEmbedding(f"expected probes of shape (P, {templates.n}), seen {probes.shape}")
    if not np.isfinite(probes).all():
        raise InvalidEmbedding("a probe holds a number that is not finite")
    return kind


def _check_finite(batch: SubspaceBatch) -> None:
    # A sum is not finite if any of its terms is not, and needs no temporary of the batch's size.
    if not np.isfinite(batch.feet.sum()) or not np.isfinite(batch.bases.sum()):
        raise InvalidTemplate("a template holds a number that is not finite")
