"""Probes that pass the service's input checks, and such probes from inside a template."""

import numpy as np
from numpy.typing import NDArray

from attacks.stored.nearest_neighbour import nearest_points
from templates.contract.document import Calibration
from templates.errors import InvalidEmbedding
from templates.space.embedding import unit_rows
from templates.space.subspace import SubspaceBatch


def honest_embedding(probes: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which raw probes (P, n) pass the service's input check."""
    passed = np.ones(len(probes), dtype=np.bool_)
    for row, probe in enumerate(probes):
        try:
            unit_rows(probe, n=probes.shape[1], most=1)
        except InvalidEmbedding:
            passed[row] = False
    return passed


def honest_lift(probes: SubspaceBatch, calibration: Calibration) -> NDArray[np.bool_]:
    """Return which lifted probes have a foot point that the calibration takes for honest."""
    low, high = calibration.foot_point_norm or (1.0, 0.0)
    return np.asarray((low <= probes.foot_norms) & (probes.foot_norms <= high))


def points_inside(templates: SubspaceBatch, *, seed: int) -> NDArray[np.float32]:
    """Return a random unit vector of every template, (T, n): at distance 0 from it."""
    directions = np.random.default_rng(seed).standard_normal((len(templates), templates.n))
    return nearest_points(directions, templates).astype(np.float32)


def flats_inside(templates: SubspaceBatch, m: int, *, foot_norm: float) -> SubspaceBatch:
    """Return an affine subspace of dimension m inside every template, at distance 0 from it.

    Where the template has more dimensions, the foot point is moved along one of them to have the
    norm of an honest lift's.
    """
    if templates.m <= m:
        return templates
    norms = templates.foot_norms[:, None]
    height = np.sqrt(np.maximum(foot_norm**2 - norms**2, 0))
    return SubspaceBatch(
        (templates.feet + height * templates.bases[:, m]).astype(np.float32), templates.bases[:, :m]
    )


def honest_flats(templates: SubspaceBatch, calibration: Calibration) -> SubspaceBatch:
    """Return ``flats_inside`` of a foot point norm that the calibration takes for honest."""
    low, high = calibration.foot_point_norm or (0.0, 1.0)
    # Near the lower end: a foot point can be made longer inside a template, and not shorter.
    return flats_inside(templates, calibration.probe_m, foot_norm=low + 0.1 * (high - low))
