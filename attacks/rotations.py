"""Templates as a thief sees them who lacks a key: each turned by a secret rotation of its own."""

from collections.abc import Sequence

import numpy as np

from attacks.bed import Testbed
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import Rotation, TenantRotation, holder_rotation
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes

KEPT = "holder's key kept"
"""The variant of a row whose templates are turned as a holder's key turns them."""


def rotations_of(bed: Testbed, tenant: str, templates: str, count: int) -> list[Rotation]:
    """Return the rotations of some templates of a tenant of the experiment, one for each."""
    stream = Keystream.seeded("audit", bed.seed, "tenant key", tenant)
    rotation = TenantRotation(stream.token(KEY_BYTES), bed.source.k)
    return [rotation.of(f"{templates} {number}") for number in range(count)]


def holder_rotations_of(bed: Testbed, enrollment: str, count: int) -> list[Rotation]:
    """Return the rotations of an enrollment of some people, each under a key of their own."""
    stream = Keystream.seeded("audit", bed.seed, "holder keys")
    keys = [stream.token(KEY_BYTES) for _ in range(count)]
    return [
        holder_rotation(key, f"{enrollment} {number}", bed.source.k)
        for number, key in enumerate(keys)
    ]


def turned(batch: SubspaceBatch, rotations: Sequence[Rotation]) -> SubspaceBatch:
    """Turn each template by its rotation."""
    pairs = zip(batch, rotations, strict=True)
    return SubspaceBatch.of([template.turned_by(rotation.turned) for template, rotation in pairs])


def turned_probes(probes: Probes, rotations: Sequence[Rotation]) -> Probes:
    """Turn each probe by its rotation, (V, k) float32 or lifted ones."""
    if isinstance(probes, SubspaceBatch):
        return turned(probes, rotations)
    pairs = zip(probes, rotations, strict=True)
    return np.concatenate([rotation.turned(probe[None]) for probe, rotation in pairs]).astype(
        np.float32
    )
