"""One scheme in service: templates of victims, the contract that decides, what an attacker has."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.cast import ENROLLED_PHOTOS, Cast, Person
from attacks.errors import AuditError
from attacks.outcomes import POOLED, Scheme
from templates.contract.canonical import Json
from templates.contract.document import Binding, Calibration, Contract, Level
from templates.contract.nobody import Nobody
from templates.decoys import DecoyPool, DecoySource
from templates.distances import DEFAULT_STEPS, Metric
from templates.errors import Uncalibrated
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from templates.space.subspace import SubspaceBatch
from verify import CalibrationOptions, calibrate
from verify.cohort import client_source, make_cohort, people_like
from verify.comparisons import Lifter
from verify.metrics import most_errors, threshold_at_fmr
from verify.strangers import make_nobody

LIFTED_PROBE_DIM = 8
"""Dimension of the lifted probes that wolves are tried with, the best of docs/method.md §4.7."""
_TILE = 1024
_STRANGERS = 50


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """What attacks on templates act on.

    Nothing is rotated: a tenant's rotation changes no distance inside the tenant. Attacks that
    cross tenants rotate by themselves.

    Parameters
    ----------
    scheme
        What protects the templates.
    contract
        Calibrated on people who are neither victims, nor decoys, nor the attacker's.
    lifter
        Lifts as the service does, through the wire format (float16).
    victims
        Who is attacked; ``victims.enrolled`` is the truth that an attack wants.
    templates : SubspaceBatch of V
        One template of each victim.
    source
        The scheme's decoys; None where it takes none.
    owners
        The people whose ``enrolled`` descriptors are the entries of the pool, in its order; None
        where no fresh photos of them are at hand.
    attacker : (A, n) float32
        Faces of other people, which the attacker has.
    raw_thresholds
        By level, the cosine at which raw descriptors of the calibration have the level's FMR.
    seed
        Of all that is random.
    """

    scheme: Scheme
    contract: Contract
    lifter: Lifter
    victims: Person
    templates: SubspaceBatch
    source: DecoySource | None
    owners: Person | None
    attacker: NDArray[np.float32]
    raw_thresholds: Mapping[str, float]
    seed: int

    @property
    def levels(self) -> tuple[Level, ...]:
        """Return the levels of the point-to-subspace calibration that have a raw threshold."""
        levels = self.points.levels
        return tuple(level for level in levels if level.name in self.raw_thresholds)

    @property
    def points(self) -> Calibration:
        """The calibration of raw probes."""
        return self.contract.calibration("p2s")

    @property
    def lifted(self) -> Calibration | None:
        """The calibration of lifted probes, of the largest dimension; None where there is none.

        The largest is where lifted wolves open most (docs/method.md §4.7).
        """
        found = [each for each in self.contract.calibrations if each.mode == "s2s"]
        return max(found, key=lambda each: each.probe_m, default=None)

    @property
    def level(self) -> Level:
        """The level that the service decides with by default."""
        return self.points.level(self.contract.default_level)

    def first(self, count: int) -> "Scene":
        """Return the scene with the first victims only, for attacks that take long."""
        return replace(self, victims=self.victims.first(count), templates=self.templates[:count])

    def lift(
        self, descriptors: NDArray[np.float32], purpose: str, *, m: int | None = None
    ) -> SubspaceBatch:
        """Lift further descriptors, (N, n), with randomness of this purpose only."""
        with Keystream.seeded("audit", self.seed, str(self.scheme), purpose) as stream:
            return self.lifter.lift(descriptors, m=m or self.scheme.dim, stream=stream)


def raw_thresholds(
    descriptors: NDArray[np.float32], names: tuple[str, ...], targets: Mapping[str, float]
) -> dict[str, float]:
    """Cosines that at most a share of all pairs of two people reach.

    Parameters
    ----------
    descriptors : (N, n) float32
    names
        N people.
    targets
        FMR by name of the level.
    """
    person = np.unique(np.asarray(names), return_inverse=True)[1]
    upper: list[NDArray[np.float32]] = []
    pairs = 0
    keep = most_errors(max(targets.values()), len(person) ** 2 // 2) + 2
    for start in range(0, len(person), _TILE):
        rows = slice(start, start + _TILE)
        cosines = descriptors[rows] @ descriptors.T
        later = np.arange(len(person)) > np.arange(start, start + len(cosines))[:, None]
        apart = later & (person[rows, None] != person)
        pairs += int(np.count_nonzero(apart))
        tail = np.concatenate([*upper, cosines[apart]])
        if len(tail) > keep:
            tail = np.partition(tail, len(tail) - keep)[-keep:]
        upper = [tail]
    if not pairs:
        raise AuditError("a raw threshold needs photos of two people")
    return {
        level: threshold_at_fmr(upper[0], target, trials=pairs) for level, target in targets.items()
    }


def stage(
    cast: Cast,
    scheme: Scheme,
    source: DecoySource | None,
    *,
    embedder_sha256: str,
    preprocessing: Mapping[str, Json],
    pool_of_owners: bool,
    contract: Contract | None = None,
    lifted_probes: bool = True,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
    seed: int,
) -> Scene:
    """Enroll the victims under a scheme, and calibrate where no contract is given.

    Parameters
    ----------
    source
        Of ``scheme.decoys``; its pool's entries are ``cast.owners.enrolled`` where
        ``pool_of_owners``.
    contract
        The contract that a service uses; it must be of this scheme and source.
    lifted_probes
        Calibrate lifted probes too, without which no lifted wolf is tried.

    Raises
    ------
    AuditError
        The contract is of another scheme, or the scheme is of raw descriptors.
    ContractMismatch
        The contract is of another model or other decoys.
    """
    n = cast.victims.enrolled.shape[1]
    strategy = Strategy(scheme.strategy)
    if scheme.decoys is not None and source is None:
        raise AuditError(f"{scheme} needs decoys: name a file of `decoys build` with --decoys")
    chosen = source or DecoyPool(cast.attacker)
    binding = Binding(
        embedder_sha256=embedder_sha256,
        preprocessing=dict(preprocessing),
        n=n,
        strategy=strategy,
        m=scheme.dim,
        decoy_source_id=chosen.source_id,
        rotation_version=ROTATION_VERSION,
    )
    if contract is None:
        cohort, nobody = _cohort(cast, chosen, strategy, scheme.dim, seed)
        contract = calibrate(
            cast.calibration,
            cast.names,
            binding=binding,
            source=chosen,
            options=CalibrationOptions(
                probe_dims=(0, min(LIFTED_PROBE_DIM, scheme.dim)) if lifted_probes else (0,),
                metric=Metric.SPHERICAL,
                lifted_probes=500,
                lifted_impostor_pairs=60_000,
                seed=seed,
            ),
            cohort=cohort,
            nobody=nobody,
            progress=progress,
        ).contract
    elif contract.binding != binding:
        raise AuditError(
            "the contract is of another scheme, model or decoy source than the audit's: give the "
            "pack and the decoys that `calibrate` was given"
        )
    lifter = Lifter(strategy, chosen, contract.contract_id)
    with Keystream.seeded("audit", seed, str(scheme), "victims") as stream:
        templates = lifter.lift(cast.victims.enrolled, m=scheme.dim, stream=stream)
    levels = {
        level.name: level.target_fmr
        for level in contract.calibration("p2s").levels
        if level.target_fmr is not None
    }
    if contract.default_level not in levels:
        raise Uncalibrated(
            f"an audit judges by a level with a target FMR, and {contract.default_level} has none"
        )
    return Scene(
        scheme=scheme,
        contract=contract,
        lifter=lifter,
        victims=cast.victims,
        templates=templates,
        source=None if scheme.decoys is None else chosen,
        owners=cast.owners if pool_of_owners and scheme.decoys == POOLED else None,
        attacker=cast.attacker,
        raw_thresholds=raw_thresholds(cast.calibration, cast.names, levels),
        seed=seed,
    )


def _cohort(
    cast: Cast, source: DecoySource, strategy: Strategy, m: int, seed: int
) -> tuple[SubspaceBatch, Nobody]:
    """Make the cohort as ``calibrate`` does, of a seed: one audit gives the same figures twice.

    The strangers are few: an audit enrolls no template that a client sent.
    """
    person = np.unique(cast.names, return_inverse=True)[1]
    means = np.stack(
        [
            cast.calibration[np.flatnonzero(person == one)[:ENROLLED_PHOTOS]].mean(axis=0)
            for one in range(person.max() + 1)
        ]
    )
    people = np.asarray(means / np.linalg.norm(means, axis=1, keepdims=True), dtype=np.float32)
    generator = client_source(source)
    hidden = people_like(generator, people)
    with Keystream.seeded("audit", seed, strategy, m, "cohort") as stream:
        cohort = make_cohort(generator, strategy=strategy, m=m, stream=stream, hidden=hidden)
        nobody = make_nobody(
            generator,
            strangers=(hidden,),
            cohort=cohort,
            metric=Metric.SPHERICAL,
            steps=DEFAULT_STEPS,
            stream=stream,
            size=_STRANGERS,
        )
    return cohort, nobody


def owners_pool(cast: Cast, made_with: str | None) -> DecoyPool:
    """Return the pool of real people that the decoy owners make up."""
    return DecoyPool(cast.owners.enrolled, made_with=made_with)
