"""Wolves: probes near every face (docs/method.md §4.7), and probes that are no face at all.

Wolves are chosen and improved on templates that the attacker lifts; the victims' templates and the
service's cohort are met once, at the end.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Probes, attack
from attacks.bed import Testbed
from attacks.decisions import score
from attacks.outcomes import Knowledge, Property
from attacks.point_ascent import ascend_points
from attacks.presented import passes_checks
from attacks.wolf_ascent import Ground, ascend_subspaces
from templates.contract.document import Calibration, Level
from templates.contract.nobody import Nobody
from templates.decoys import client_source
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.lifting import plain_strategy
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes as Sent
from verify.comparisons import through_wire

TARGETS = 150
"""Templates that the attacker lifts to climb on; as many again to choose among the ends."""
COHORT_CLIMBED = 150
"""Of the attacker's cohort, those that the score is normalised by while it climbs; all of them
decide which end is best."""
STARTS = 6
AXES = 64
CENTRAL = "axes through the origin"
ALONG_MEAN = "foot point along the mean face"
_FOOT_FACTORS = (0.8, 1.0, 1.2)
_FROM_OUTSIDE = Knowledge(template=False, generator=True)
_LIFTS = Knowledge(template=False, faces=True, lifting=True)

Array = NDArray[np.float64]


@attack(breaks=Property.IMPERSONATION, needs=_FROM_OUTSIDE)
def no_face(bed: Testbed) -> Iterator[Probes]:
    """The zero vector is sent, or random subspaces through the coordinate origin."""
    yield Probes(np.zeros((1, bed.source.k), dtype=np.float32), "zero embedding")
    if bed.lifted is not None:
        rng = np.random.default_rng(bed.seed)
        shape = bed.lifted.probe_m, bed.source.k
        central = [
            canonical(np.zeros(shape[1]), rng.standard_normal(shape)) for _ in bed.templates.feet
        ]
        yield Probes(SubspaceBatch.of(central), "random central subspaces")


@attack(breaks=Property.IMPERSONATION, needs=_LIFTS)
def wolf_embedding(bed: Testbed) -> Iterator[Probes]:
    """The mean face or a principal axis is sent, or what climbed from them on own templates.

    The best is taken: that which most of the attacker's own templates accept.
    """
    own = OwnTemplates.of(bed)
    plain = plain_wolves(bed.gallery)
    starts = np.concatenate([plain, bed.gallery[:STARTS]])
    climbed = ascend_points(starts, own.targets, bed.nobody, threshold=bed.level.threshold)
    for variant, candidates in (("axes of faces", plain), ("optimised", climbed)):
        shares = own.accepted_shares(candidates, bed, bed.points, bed.level)
        yield Probes(candidates[[int(np.argmax(shares))]], variant)


@attack(breaks=Property.IMPERSONATION, needs=_LIFTS)
def lifted_wolf(bed: Testbed) -> Iterator[Probes]:
    """Principal axes of faces are sent as a lifted probe, or what climbed from them.

    The best is taken: that which most of the attacker's own templates accept.
    """
    if bed.lifted is None:
        return
    calibration, own = bed.lifted, OwnTemplates.of(bed)
    level = calibration.level(bed.service.default_level)
    low, high = calibration.foot_point_norm or (0.0, 1.0)
    wolves = axis_wolves(
        bed.gallery, calibration.probe_m, foot_norm=(low + high) / 2, seed=bed.seed
    )

    def best(made: SubspaceBatch) -> SubspaceBatch:
        received = through_wire(made, contract_id=bed.service.contract_id)
        honest = passes_checks(received, calibration)
        kept = received[honest] if honest.any() else received
        shares = own.accepted_shares(kept, bed, calibration, level)
        return kept[np.argsort(-shares)]

    for family, batch in wolves.items():
        yield Probes(best(batch)[:1], family)
    leading = best(SubspaceBatch.of(list(wolves.values())))[:STARTS]
    ground = Ground.of(own.targets, own.cohort[:COHORT_CLIMBED], level)
    yield Probes(best(ascend_subspaces(leading, ground))[:1], "optimised")


@dataclass(frozen=True, eq=False, repr=False)
class OwnTemplates:
    """What the attacker lifts on their own.

    Parameters
    ----------
    targets, held_out
        Templates of the attacker's faces: to climb on, and to choose with.
    cohort
        Made as the service makes one, which lifted probes are held against.
    """

    targets: SubspaceBatch
    held_out: SubspaceBatch
    cohort: SubspaceBatch

    @classmethod
    def of(cls, bed: Testbed) -> "OwnTemplates":
        """Lift the attacker's faces, and a cohort with the generator that clients have.

        Templates are lifted with the scheme's decoys, which of a pool takes the pool.
        """
        faces = np.random.default_rng(bed.seed).permutation(bed.gallery)[: 2 * TARGETS]
        half = len(faces) // 2
        stream = Keystream.seeded("audit", bed.seed, str(bed.scheme), "attacker's cohort")
        seed = stream.token(KEY_BYTES)
        generator = client_source(bed.source)
        return cls(
            targets=bed.lift(faces[:half], "attacker's targets"),
            held_out=bed.lift(faces[half:], "attacker's held-out targets"),
            cohort=Nobody(generator, plain_strategy(bed.strategy), bed.m, seed).cohort,
        )

    def accepted_shares(
        self, probes: Sent, bed: Testbed, calibration: Calibration, level: Level
    ) -> Array:
        """Share of the held-out templates that accept each probe.

        Lifted probes are held against the attacker's own cohort, for the service's is secret.
        Ties, such as where none accepts, are broken by the mean similarity.
        """
        scores = score(probes, self.held_out, bed.nobody, calibration, cohort=self.cohort)
        # Similarities lie in [-1, 1]: their mean, scaled, never outweighs one acceptance.
        tie = scores.similarities.mean(axis=1) / (4 * len(self.held_out))
        return np.asarray(scores.at(level).mean(axis=1) + tie, dtype=np.float64)


def plain_wolves(faces: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean face and principal axes of faces (N, k), alone and with the mean face."""
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2][:STARTS]
    length = float(np.linalg.norm(mean))
    rows = np.concatenate([mean[None], axes, -axes, mean + length * axes, mean - length * axes])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)


def axis_wolves(
    faces: NDArray[np.float32], m: int, *, foot_norm: float, seed: int
) -> dict[str, SubspaceBatch]:
    """Lifted probes of dimension m near everybody, learnt from (N, k) unit embeddings; by family.

    Parameters
    ----------
    foot_norm
        Norm of an honest probe's foot point; wolves have it, a fifth less and a fifth more, and 0.
    """
    rng = np.random.default_rng(seed)
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2][:AXES].astype(np.float64)
    uncentred = np.linalg.svd(faces.astype(np.float64), full_matrices=False)[2][:AXES]

    def bases() -> Iterator[Array]:
        yield axes[:m]
        yield uncentred[:m]
        yield axes[m : 2 * m]
        for width in (2, 4):
            taken = axes[: width * m]
            for _ in range(4):
                mix = np.linalg.qr(rng.standard_normal((len(taken), m)))[0]
                yield mix.T @ taken

    wolves: dict[str, list[SubspaceBatch]] = {CENTRAL: [], ALONG_MEAN: []}
    for basis in bases():
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
