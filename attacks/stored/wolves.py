"""Wolves: probes near every face (docs/method.md §4.7).

They are chosen on templates that the attacker lifts; the victims' templates and the service's
cohort are met once, at the end.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Probes, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from attacks.presented import passes_checks, scored
from templates.contract.document import Calibration
from templates.contract.nobody import Nobody
from templates.decoys import client_source
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.lifting import plain_strategy
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes as Sent
from verify.comparisons import through_wire

TARGETS = 150
"""Templates that the attacker lifts to choose by."""
AXES = 64
_LEADING = 6
_FOOT_FACTORS = (0.8, 1.0, 1.2)
_LIFTS = Knowledge(template=False, faces=True, lifting=True)

Array = NDArray[np.float64]


@attack(breaks=Property.IMPERSONATION, needs=_LIFTS)
def wolf_embedding(bed: Testbed) -> Iterator[Probes]:
    """Of the mean face and principal axes, one that most of the attacker's own lifts accept."""
    wolves = plain_wolves(bed.gallery)
    yield Probes(wolves[_ranked(bed, wolves, bed.points)[:1]], "axes of faces")


@attack(breaks=Property.IMPERSONATION, needs=_LIFTS)
def lifted_wolf(bed: Testbed) -> Iterator[Probes]:
    """Of lifted principal axes of faces, one that most of the attacker's own lifts accept."""
    if bed.lifted is None:
        return
    low, high = bed.lifted.foot_point_norm or (0.0, 1.0)
    wolves = axis_wolves(bed.gallery, bed.lifted.probe_m, foot_norm=(low + high) / 2, seed=bed.seed)
    received = through_wire(wolves, contract_id=bed.service.contract_id)
    honest = passes_checks(received, bed.lifted)
    kept = received[honest] if honest.any() else received
    yield Probes(kept[_ranked(bed, kept, bed.lifted)[:1]], "foot point along the mean face")


def _ranked(bed: Testbed, wolves: Sent, calibration: Calibration) -> NDArray[np.int64]:
    """Places of the wolves, those that most of the attacker's own templates accept first.

    Lifted wolves are held against a cohort of the attacker's own, for the service's is secret.
    """
    faces = np.random.default_rng(bed.seed).permutation(bed.gallery)[:TARGETS]
    stream = Keystream.seeded("audit", bed.seed, str(bed.scheme), "attacker's cohort")
    nobody = Nobody(
        client_source(bed.source), plain_strategy(bed.strategy), bed.m, stream.token(KEY_BYTES)
    )
    scores = scored(wolves, bed.lift(faces, "attacker's targets"), nobody, calibration)
    accepted = scores >= calibration.level(bed.service.default_level).threshold
    return np.lexsort((-scores.mean(axis=1), -accepted.mean(axis=1)))


def plain_wolves(faces: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean face and principal axes of faces (N, k), alone and with the mean face."""
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2][:_LEADING]
    length = float(np.linalg.norm(mean))
    rows = np.concatenate([mean[None], axes, -axes, mean + length * axes, mean - length * axes])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)


def axis_wolves(
    faces: NDArray[np.float32], m: int, *, foot_norm: float, seed: int
) -> SubspaceBatch:
    """Lifted probes of dimension m near everybody, learnt from (N, k) unit embeddings.

    ``foot_norm`` is that of an honest probe's foot point: wolves have it, a fifth less and a fifth
    more. Their foot points lie along the mean face; one at the origin fails the input checks.
    """
    rng = np.random.default_rng(seed)
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2][:AXES].astype(np.float64)
    uncentred = np.linalg.svd(faces.astype(np.float64), full_matrices=False)[2][:AXES]
    bases = [axes[:m], uncentred[:m], axes[m : 2 * m]]
    for width in (2, 4):
        taken = axes[: width * m]
        mixes = (np.linalg.qr(rng.standard_normal((len(taken), m)))[0] for _ in range(4))
        bases += [mix.T @ taken for mix in mixes]
    wolves = []
    for basis in bases:
        direction = mean - basis.T @ (basis @ mean)
        direction /= np.linalg.norm(direction)
        for factor in _FOOT_FACTORS:
            wolves.append(canonical(min(factor * foot_norm, 0.99) * direction, basis))
    return SubspaceBatch.of(wolves)


def canonical(foot: Array, basis: Array) -> SubspaceBatch:
    """Orthonormalise a basis (m, k), and make the foot point (k,) orthogonal to it."""
    orthonormal = np.linalg.qr(basis.T)[0].T
    return SubspaceBatch(
        feet=(foot - orthonormal.T @ (orthonormal @ foot)).astype(np.float32),
        bases=np.ascontiguousarray(orthonormal, dtype=np.float32),
    )
