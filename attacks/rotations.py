"""Templates as a thief sees them who lacks a key: each turned by a secret rotation of its own."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.bed import Testbed
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import SignedCosineRotation, TenantRotation, holder_rotation
from templates.space.subspace import SubspaceBatch, Turn
from verify.cohort import Probes

KEPT = "holder's key kept"
"""The variant of a row whose templates are turned as a holder's key turns them."""


def rotations_of(
    bed: Testbed, tenant: str, templates: str, count: int
) -> list[SignedCosineRotation]:
    """Return the rotations of some templates of a tenant of the experiment, one for each."""
    stream = Keystream.seeded("audit", bed.seed, "tenant key", tenant)
    rotation = TenantRotation(stream.token(KEY_BYTES), bed.source.k)
    return [rotation.of(f"{templates} {number}") for number in range(count)]


def holder_rotations_of(bed: Testbed, enrollment: str, count: int) -> list[SignedCosineRotation]:
    """Return the rotations of an enrollment of some people, each under a key of their own."""
    stream = Keystream.seeded("audit", bed.seed, "holder keys")
    keys = [stream.token(KEY_BYTES) for _ in range(count)]
    return [
        holder_rotation(key, f"{enrollment} {number}", bed.source.k)
        for number, key in enumerate(keys)
    ]


def turned(batch: SubspaceBatch, rotations: Sequence[SignedCosineRotation]) -> SubspaceBatch:
    """Turn each template by its rotation."""
    return _each_turned(batch, [rotation.turned for rotation in rotations])


def turned_back(batch: SubspaceBatch, rotations: Sequence[SignedCosineRotation]) -> SubspaceBatch:
    """Undo :func:`turned`."""
    return _each_turned(batch, [rotation.turned_back for rotation in rotations])


def _each_turned(batch: SubspaceBatch, turns: Sequence[Turn]) -> SubspaceBatch:
    pairs = zip(batch, turns, strict=True)
    return SubspaceBatch.of([template.turned_by(turn) for template, turn in pairs])


def turned_probes(probes: Probes, rotations: Sequence[SignedCosineRotation]) -> Probes:
    """Turn each probe by its rotation, (V, k) float32 or lifted ones."""
    if isinstance(probes, SubspaceBatch):
        return turned(probes, rotations)
    return np.ascontiguousarray(turned_points(probes, rotations), dtype=np.float32)


def turned_points(
    points: NDArray[np.floating], rotations: Sequence[SignedCosineRotation]
) -> NDArray[np.float64]:
    """Turn each point, (V, k), by its rotation."""
    pairs = zip(points, rotations, strict=True)
    return np.concatenate([rotation.turned(point[None]) for point, rotation in pairs])
