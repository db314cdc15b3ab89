"""One scheme in service: templates of victims, the contract that decides, what an attacker has."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.outcomes import POOLED, Scheme
from attacks.population import Population, Subjects
from templates.contract.canonical import Json
from templates.contract.document import Binding, Calibration, Contract, Level
from templates.contract.nobody import Nobody
from templates.decoys import Attributes, DecoyPool, DecoySource
from templates.distances import Metric
from templates.errors import Uncalibrated
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify import CalibrationOptions, calibrate
from verify.comparisons import through_wire
from verify.metrics import most_errors, threshold_at_fmr

LIFTED_PROBE_DIM = 8
"""Dimension of the lifted probes that wolves are tried with, the best of docs/method.md §4.7."""
_TILE = 1024


@dataclass(frozen=True, eq=False, repr=False)
class System:
    """What attacks on templates act on, all of it in the coordinates that templates have.

    Nothing is rotated: a probe is turned as the template that it is compared with, and no distance
    changes. Attacks on what is stored, by who lacks the tenant's key, rotate by themselves.

    Parameters
    ----------
    contract
        Calibrated on people who are neither victims, nor decoys, nor the attacker's.
    source
        The decoys of the deployment, on as many axes as its templates have. A scheme without
        decoys takes none of them.
    victims
        Who is attacked; ``victims.enrolled`` is the truth that an attack wants.
    templates : SubspaceBatch of V
        One template of each victim.
    attacker : (A, k) float32
        Faces of other people, which the attacker has, one of each.
    raw_thresholds
        By level, the cosine at which projected embeddings of the calibration have the level's FMR.
    """

    scheme: Scheme
    contract: Contract
    source: DecoySource
    victims: Subjects
    templates: SubspaceBatch
    attacker: NDArray[np.float32]
    raw_thresholds: Mapping[str, float]
    seed: int

    @property
    def strategy(self) -> Strategy:
        """How templates are lifted."""
        return Strategy(self.scheme.strategy)

    @property
    def decoys(self) -> int:
        """Number of decoys in one template."""
        return self.strategy.decoys(self.scheme.dim)

    @property
    def nobody(self) -> Nobody:
        """Templates of nobody under the contract."""
        return self.contract.nobody(self.source)

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
        calibrations = [
            calibration for calibration in self.contract.calibrations if calibration.mode == "s2s"
        ]
        return max(calibrations, key=lambda calibration: calibration.probe_m, default=None)

    @property
    def level(self) -> Level:
        """The level that the service decides with by default."""
        return self.points.level(self.contract.default_level)

    @cached_property
    def renewed(self) -> SubspaceBatch:
        """Templates of the victims' fresh photos, lifted once."""
        return self.lift(self.victims.fresh, "renewed from the fresh photo")

    def first(self, count: int) -> "System":
        """Return the system with the first victims only, for attacks that take long."""
        return replace(self, victims=self.victims.first(count), templates=self.templates[:count])

    def lift(
        self, points: NDArray[np.float32], purpose: str, *, m: int | None = None
    ) -> SubspaceBatch:
        """Lift further points, (N, k), as they are stored; with randomness of this purpose only."""
        plus = self.strategy is Strategy.HYBRID_PLUS
        with Keystream.seeded("audit", self.seed, str(self.scheme), purpose) as stream:
            lifted = lift(
                points,
                strategy=self.strategy,
                m=m or self.scheme.dim,
                source=self.source,
                stream=stream,
                attributes=[Attributes()] * len(points) if plus else None,
            )
        return through_wire(lifted, contract_id=self.contract.contract_id)


def raw_thresholds(
    descriptors: NDArray[np.float32], names: tuple[str, ...], targets: Mapping[str, float]
) -> dict[str, float]:
    """Cosines that at most a share of all pairs of two people reach.

    Parameters
    ----------
    descriptors : (N, k) float32
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


def enroll_victims(
    population: Population,
    scheme: Scheme,
    source: DecoySource | None,
    *,
    embedder_sha256: str,
    preprocessing: Mapping[str, Json],
    contract: Contract | None = None,
    lifted_probes: bool = True,
    seed: int,
) -> System:
    """Enroll the victims under a scheme, and calibrate where no contract is given.

    Parameters
    ----------
    source
        Of ``scheme.decoys``, on the scheme's axes.
    contract
        The contract that a service uses; it must be of this scheme and source.
    lifted_probes
        Calibrate lifted probes too, without which no lifted wolf is tried.

    Raises
    ------
    AuditError
        The contract is of another scheme, or the scheme is of raw embeddings.
    ContractMismatch
        The contract is of another model or other decoys.
    """
    strategy = Strategy(scheme.strategy)
    if scheme.decoys is not None and source is None:
        raise AuditError(f"{scheme} needs decoys")
    chosen = source or DecoyPool(population.attacker)
    binding = Binding(
        embedder_sha256=embedder_sha256,
        preprocessing=dict(preprocessing),
        n=chosen.n,
        axes=chosen.k,
        strategy=strategy,
        m=scheme.dim,
        decoy_source_id=chosen.source_id,
        rotation_version=ROTATION_VERSION,
    )
    if contract is None:
        contract = _calibrated(population, binding, chosen, lifted_probes=lifted_probes, seed=seed)
    elif contract.binding != binding:
        raise AuditError(
            "the contract is of another scheme, model or decoy source than the audit's: give the "
            "pack and the decoys that `calibrate` was given"
        )
    levels = {
        level.name: level.target_fmr
        for level in contract.calibration("p2s").levels
        if level.target_fmr is not None
    }
    if contract.default_level not in levels:
        raise Uncalibrated(
            f"an audit judges by a level with a target FMR, and {contract.default_level} has none"
        )
    victims = population.victims.along(chosen)
    system = System(
        scheme=scheme,
        contract=contract,
        source=chosen,
        victims=victims,
        templates=SubspaceBatch(
            np.empty((0, chosen.k), np.float32), np.empty((0, scheme.dim, chosen.k), np.float32)
        ),
        attacker=chosen.project(population.attacker),
        raw_thresholds=raw_thresholds(
            chosen.project(population.calibration), population.names, levels
        ),
        seed=seed,
    )
    return replace(system, templates=system.lift(victims.enrolled, "victims"))


def _calibrated(
    population: Population,
    binding: Binding,
    source: DecoySource,
    *,
    lifted_probes: bool,
    seed: int,
) -> Contract:
    """Calibrate as a service does, with a cohort of a seed: audits give the same figures twice."""
    with Keystream.seeded("audit", seed, binding.strategy, binding.m, "cohort") as stream:
        cohort_seed = stream.token(KEY_BYTES)
    options = CalibrationOptions(
        probe_dims=(0, min(LIFTED_PROBE_DIM, binding.m)) if lifted_probes else (0,),
        probe_photos=(1,),
        metric=Metric.SPHERICAL,
        lifted_probes=500,
        lifted_impostor_pairs=60_000,
        seed=seed,
    )
    return calibrate(
        population.calibration,
        population.names,
        binding=binding,
        source=source,
        options=options,
        cohort_seed=cohort_seed,
    ).contract


def owners_pool(population: Population, made_with: str | None) -> DecoyPool:
    """Return the pool of real people that the decoy owners make up."""
    return DecoyPool(population.owners.enrolled, made_with=made_with)


def of_pool(system: System) -> DecoyPool | None:
    """Return the pool that a scheme's decoys are drawn from; None of another scheme."""
    pooled = system.scheme.decoys == POOLED and isinstance(system.source, DecoyPool)
    return system.source if pooled and isinstance(system.source, DecoyPool) else None
