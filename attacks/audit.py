"""The audit of templates: every attack on a template that we know, on people with photos."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.bed import Testbed
from attacks.outcomes import AttackOutcome, AuditError
from attacks.population import Population, draw_population
from attacks.runner import run_attack
from attacks.setup import AttackSetup
from attacks.stored import attacks_on_templates
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.document import Binding, Contract
from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.distances import Metric
from templates.errors import Uncalibrated
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.lifting import Strategy
from verify import CalibrationOptions, calibrate
from verify.own_decoys import require_others
from verify.preparation import binding_for

DEFAULT_SHARE = 0.83
"""Of the decoys' variance, on the axes that are taken where nobody says how many."""
LIFTED_PROBE_DIM = 8
"""Dimension of the lifted probes that wolves are tried with, the best of docs/method.md §4.7."""


@dataclass(frozen=True, kw_only=True)
class AuditPlan:
    """What is attacked, and how hard.

    The contract of a service says its own scheme; without one, each of ``strategy`` and ``dims`` is
    calibrated on people who are not attacked. ``axes``: of the generator's; None for those that
    hold 83 % of the variance. ``comparison`` adds templates with decoys of the ``owners``.
    """

    strategy: Strategy = Strategy.ADVERSARIAL
    dims: tuple[int, ...] = ()
    axes: int | None = None
    contract: Contract | None = None
    victims: int = 300
    owners: int = 600
    comparison: bool = True
    calibration: CalibrationOptions = field(
        default_factory=lambda: CalibrationOptions(
            probe_dims=(0, LIFTED_PROBE_DIM),
            probe_photos=(1,),
            metric=Metric.SPHERICAL,
            lifted_probes=500,
            lifted_impostor_pairs=60_000,
        )
    )
    seed: int = 0


@dataclass(frozen=True)
class AuditResult:
    """What an audit measured: ``comparisons`` names the schemes that are there to compare with."""

    outcomes: list[AttackOutcome]
    schemes: list[dict[str, Any]]
    comparisons: list[str]
    settings: dict[str, Any]


def run_audit(
    plan: AuditPlan,
    faces: Extraction,
    identities: Sequence[str],
    *,
    pack: ModelPack,
    decoys: DecoySource,
    progress: Callable[[float], None] = lambda _share: None,
) -> AuditResult:
    """Attack the templates of some people, under every scheme of a plan.

    Parameters
    ----------
    decoys
        What the service lifts with.
    progress
        Called with the share that is done, which rises to 1.

    Raises
    ------
    AuditError
        There are too few people.
    ContractError
        The decoys were made of these people.
    """
    population = draw_population(
        faces.embeddings, identities, victims=plan.victims, owners=plan.owners, seed=plan.seed
    )
    require_others(decoys, faces.embeddings, identities)
    strategy, dims, axes = plan.strategy, plan.dims, plan.axes
    if plan.contract is not None:
        binding = plan.contract.binding
        strategy, dims, axes = binding.strategy, (binding.m,), binding.axes
    audited: list[tuple[DecoySource, int, bool]] = [(decoys, m, False) for m in dims]
    if plan.comparison and strategy.needs_decoys and isinstance(decoys, DecoyGenerator):
        pool = DecoyPool(population.owners.enrolled, made_with=decoys.made_with)
        audited += [(pool, m, True) for m in dims]
    result = AuditResult([], [], [], _settings(plan, population, decoys))
    attacks = list(attacks_on_templates())
    progress(0.0)
    for number, (source, m, compared) in enumerate(audited):
        bed = audit_bed(
            population, source, strategy, axes=axes, m=m, compared=compared, pack=pack, plan=plan
        )  # fmt: skip
        result.schemes.append({**bed.scheme.to_json(), **_operating_point(bed)})
        if compared:
            result.comparisons.append(str(bed.scheme))
        for done, attack in enumerate(attacks, start=1):
            result.outcomes.extend(run_attack(attack, bed))
            progress((number + done / len(attacks)) / len(audited))
    return result


def audit_bed(
    population: Population,
    source: DecoySource,
    strategy: Strategy,
    *,
    axes: int | None,
    m: int,
    compared: bool = False,
    pack: ModelPack,
    plan: AuditPlan,
) -> Testbed:
    """Enroll the victims under a scheme, and calibrate where the plan has no contract of it.

    Parameters
    ----------
    compared
        The scheme's decoys are of the owners, so that these are none of the attacker's faces.

    Raises
    ------
    AuditError
        The contract is of another scheme.
    Uncalibrated
        The contract's default level has no target FMR.
    """
    if isinstance(source, DecoyGenerator):
        source = source.reduced(axes or source.axes_for(DEFAULT_SHARE))
    binding = binding_for(pack, source, strategy=strategy, m=m)
    contract = None if compared else plan.contract
    if contract is None:
        contract = _calibrated(population, binding, source, plan)
    elif contract.binding != binding:
        raise AuditError(
            "the contract is of another scheme, model or decoy source than the audit's: give the "
            "pack and the decoys that `calibrate` was given"
        )
    if contract.calibration("p2s").level(contract.default_level).target_fmr is None:
        raise Uncalibrated(
            f"an audit judges by a level with a target FMR, and {contract.default_level} has none"
        )
    faces, names = _known(population, with_owners=not compared)
    setup = AttackSetup.of(
        population.victims,
        faces,
        source,
        owners=np.unique(np.asarray(names, dtype=np.str_), return_inverse=True)[1],
        seed=plan.seed,
    )
    bed = setup.bed(strategy, axes=source.k, m=m, contract=contract)
    # The owners are those of the pool that is compared with, and of no pool of the deployment.
    owners = population.owners.along(source) if compared else None
    return replace(bed, albums=population.albums, owners=owners)


def _calibrated(
    population: Population, binding: Binding, source: DecoySource, plan: AuditPlan
) -> Contract:
    """Calibrate as a service does, with a cohort of a seed: audits give the same figures twice."""
    stream = Keystream.seeded("audit", plan.seed, binding.strategy, binding.m, "cohort")
    cohort_seed = stream.token(KEY_BYTES)
    dims = tuple(min(dim, binding.m) for dim in plan.calibration.probe_dims)
    return calibrate(
        population.others,
        population.names,
        binding=binding,
        source=source,
        options=replace(plan.calibration, probe_dims=dims, seed=plan.seed),
        cohort_seed=cohort_seed,
    ).contract


def _known(population: Population, *, with_owners: bool) -> tuple[NDArray[np.float32], list[str]]:
    """All photos of other people that a strong attacker has, and whose each is."""
    rows, names = [population.others], [*population.names]
    if with_owners:
        rows += [population.owners.enrolled, population.owners.fresh]
        names += 2 * [f"owner {number}" for number in range(len(population.owners))]
    return np.concatenate(rows), names


def _operating_point(bed: Testbed) -> dict[str, Any]:
    return {
        "default_level": bed.level.name,
        "levels": [level.to_json() for level in bed.points.levels],
        "match_cosine": bed.match_cosine,
        "template_bytes": wire.encoded_size(bed.source.k, bed.m),
    }


def _settings(plan: AuditPlan, population: Population, decoys: DecoySource) -> dict[str, Any]:
    return {
        "victims": plan.victims,
        "decoy_owners": plan.owners,
        "attacker_faces": len(_known(population, with_owners=True)[0]),
        "calibration_people": len(set(population.names)),
        "calibration": "of the people" if plan.contract is None else "of the contract",
        "contract_id": None if plan.contract is None else plan.contract.contract_id,
        "decoy_source_id": decoys.source_id,
        "seed": plan.seed,
    }
