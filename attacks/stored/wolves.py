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
CENTRAL = "axes through the origin"
ALONG_MEAN = "foot point along the mean face"
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
    for family, made in wolves.items():
        received = through_wire(made, contract_id=bed.service.contract_id)
        honest = passes_checks(received, bed.lifted)
        kept = received[honest] if honest.any() else received
        yield Probes(kept[_ranked(bed, kept, bed.lifted)[:1]], family)


def _ranked(bed: Testbed, wolves: Sent, calibration: Calibration) -> NDArray[np.int64]:
    """Places of the wolves, those that most of the attacker's own templates accept first.

    Lifted wolves are held against a cohort of the attacker's own, for the service's is secret.
    """
    faces = np.random.default_rng(bed.seed).permutation(bed.gallery)[:TARGETS]
    cohort = None
    if isinstance(wolves, SubspaceBatch):
        stream = Keystream.seeded("audit", bed.seed, str(bed.scheme), "attacker's cohort")
        seed = stream.token(KEY_BYTES)
        generator = client_source(bed.source)
        cohort = Nobody(generator, plain_strategy(bed.strategy), bed.m, seed).cohort
    scores = scored(
        wolves, bed.lift(faces, "attacker's targets"), bed.nobody, calibration, cohort=cohort
    )
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
) -> dict[str, SubspaceBatch]:
    """Lifted probes of dimension m near everybody, learnt from (N, k) unit embeddings; by family.

    ``foot_norm`` is that of an honest probe's foot point: wolves have it, a fifth less and a fifth
    more, and 0.
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
    wolves: dict[str, list[SubspaceBatch]] = {CENTRAL: [], ALONG_MEAN: []}
    for basis in bases:
        wolves[CENTRAL].append(canonical(np.zeros_like(mean), basis))
        for factor in _FOOT_FACTORS:
            direction = mean - basis.T @ (basis @ mean)
            foot = min(factor * foot_norm, 0.99) * direction / np.linalg.norm(direction)
            wolves[ALONG_MEAN].append(canonical(foot, basis))
    return {family: SubspaceBatch.of(made) for family, made in wolves.items()}


def canonical(foot: Array, basis: Array) -> SubspaceBatch:
    """Orthonormalise a basis (m, k), and make the foot point (k,) orthogonal to it."""
    orthonormal = np.linalg.qr(basis.T)[0].T
    return SubspaceBatch(
        feet=(foot - orthonormal.T @ (orthonormal @ foot)).astype(np.float32),
        bases=np.ascontiguousarray(orthonormal, dtype=np.float32),
    )
