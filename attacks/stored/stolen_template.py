"""A stolen template is sent to the service: as it is a credential, and after a new enrollment."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Probes, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from attacks.stored.foot_point import foot_points
from attacks.stored.nearest_neighbour import nearest_points
from attacks.stored.second_moments import likeliest
from templates.contract.document import Calibration
from templates.space.subspace import SubspaceBatch

_SENT = Knowledge(generator=True, faces=True)


@attack(breaks=Property.IMPERSONATION, needs=_SENT)
def stolen_template(bed: Testbed) -> Iterator[Probes]:
    """What a stolen template gives is sent, with the right to send embeddings or templates."""
    yield from probes_of(bed)


@attack(breaks=Property.RENEWABILITY, needs=_SENT)
def renewed_template(bed: Testbed) -> Iterator[Probes]:
    """What the old template gives is sent, after the victim has enrolled anew on other photos."""
    yield from probes_of(bed)


def probes_of(bed: Testbed) -> Iterator[Probes]:
    """Yield what can be made of the stolen templates."""
    for variant, points in (
        ("its foot point", foot_points(bed.templates)),
        ("a point of it", points_inside(bed.templates, seed=bed.seed)),
        ("the likeliest guess", likeliest(bed, bed.templates)),
    ):
        yield Probes(np.ascontiguousarray(points, dtype=np.float32), variant)
    if bed.lifted is not None and bed.lifted.probe_m <= bed.m:
        yield Probes(honest_flats(bed.templates, bed.lifted), "a part of it as a lifted probe")


def points_inside(templates: SubspaceBatch, *, seed: int) -> NDArray[np.float32]:
    """Return a random unit vector of every template, (T, k): at distance 0 from it."""
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
