"""The audit of templates: every attack on a template that we know, on people with photos."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.further_faces import SAME_PHOTO, FurtherFaces, strangers_among
from attacks.hill_climbing import climb_victims
from attacks.holder_keys import (
    Guess,
    guess_from_few_decoys,
    guess_with_and_without_holder_keys,
)
from attacks.learned import invert
from attacks.learned.inverter import Inverter
from attacks.linkage import link
from attacks.outcomes import GENERATED, POOLED, AttackOutcome, Scheme
from attacks.population import LEAST_FITTED, Population, draw_population, without_decoy_people
from attacks.privacy import AttackSetup, Pairs
from attacks.renewability import renew
from attacks.several_templates import several_templates
from attacks.stored import template_attacks
from attacks.stored.foot_point import foot_points
from attacks.stored.second_moments import (
    ATTACK,
    Guesser,
    audit_setup,
    second_moments_attack,
)
from attacks.system import System, enroll_victims, owners_pool
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.binding import embedding_id
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.space.lifting import Strategy
from verify.evaluation.attributes import resembling
from verify.own_decoys import require_others

LINKED = 100
"""Victims whose templates are linked across tenants: every two of them are compared."""
DEFAULT_SHARE = 0.83
"""Of the decoys' variance, on the axes that are taken where nobody says how many."""


@dataclass(frozen=True, kw_only=True)
class AuditPlan:
    """What is attacked, and how hard.

    The contract of a service says its own scheme; without one, each of ``strategy`` and ``dims`` is
    calibrated on people who are not attacked. ``axes``: of the generator's; None for those that
    hold 83 % of the variance. ``comparison`` adds templates with decoys of the ``owners``.
    ``training_seconds`` is for the inverter; None trains none.
    """

    strategy: Strategy = Strategy.ADVERSARIAL
    dims: tuple[int, ...] = ()
    axes: int | None = None
    contract: Contract | None = None
    victims: int = 300
    owners: int = 600
    comparison: bool = True
    climbed: int = 10
    attempts: int = 1000
    training_seconds: float | None = 120.0
    seed: int = 0


@dataclass(frozen=True)
class AuditResult:
    """What an audit found: ``comparisons`` names the schemes that are there to compare with."""

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
    decoys: DecoySource | None,
    further: Sequence[FurtherFaces] = (),
    progress: Callable[[float], None] = lambda _share: None,
) -> AuditResult:
    """Attack the templates of some people, under every scheme of a plan.

    Parameters
    ----------
    decoys
        What the service lifts with; None to fit a generator to people of no other group.
    further
        Faces that the attacker has beside those of ``faces``; the victims are left out.
    progress
        Called with the share that is done, which rises to 1.

    Raises
    ------
    AuditError
        There are too few people, or they are in the decoy pool.
    ContractError
        The decoys were made of these people.
    """
    population = draw_population(
        faces.descriptors, identities, victims=plan.victims, owners=plan.owners, seed=plan.seed
    )
    if len(population.attacker) < 2 * LEAST_FITTED:
        raise AuditError(
            f"the attacker has {len(population.attacker)} faces, a third of the people who are "
            f"neither victims nor decoy owners, and needs {2 * LEAST_FITTED}: ask for fewer "
            "people (victims, owners), or give a larger folder"
        )
    if decoys is None:
        fitted, population = without_decoy_people(population, seed=plan.seed)
        info = pack.info
        space = embedding_id(embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing)
        decoys = DecoyGenerator.fit(fitted, made_with=space)
    else:
        if isinstance(decoys, DecoyPool):
            _require_strangers(decoys, population)
        require_others(decoys, faces.descriptors, identities)
    beside = [
        strangers_among(more, faces.descriptors, identities, population.victims.shown)
        for more in further
    ]
    kind = " and ".join(["the audited set", *(more.name for more in beside)])
    schemes = _schemes(plan, decoys, population)
    result = AuditResult(
        [],
        [],
        [str(audited.scheme) for audited in schemes if audited.pool_of_owners],
        {
            **_settings(plan, population, decoys),
            "further_attacker_faces": [more.to_json() for more in beside],
        },
    )
    progress(0.0)
    for number, audited in enumerate(schemes):
        system = enroll_victims(
            population,
            audited.scheme,
            audited.source,
            embedder_sha256=pack.info.embedder_sha256,
            preprocessing=pack.info.preprocessing,
            contract=audited.contract,
            seed=plan.seed,
        )
        result.schemes.append({**audited.scheme.to_json(), **_operating_point(system)})
        known = _known(population, beside, with_owners=not audited.pool_of_owners)
        victims = Pairs(population.victims.enrolled, population.victims.fresh)
        setup = audit_setup(victims, *known, audited.source, seed=plan.seed)
        attacks = _attacks(plan, system, setup, population, kind)
        for done, attack in enumerate(attacks, start=1):
            result.outcomes.extend(attack())
            progress((number + done / len(attacks)) / len(schemes))
    return result


def _known(
    population: Population, beside: Sequence[FurtherFaces], *, with_owners: bool
) -> tuple[NDArray[np.float32], list[str]]:
    """All photos of other people that a strong attacker has, and whose each is."""
    rows, names = [population.known], [*population.known_names]
    if with_owners:
        rows += [population.owners.enrolled, population.owners.fresh]
        names += 2 * [f"owner {number}" for number in range(len(population.owners))]
    for more in beside:
        rows.append(more.descriptors)
        names += more.people
    return np.concatenate(rows), names


@dataclass(frozen=True, eq=False)
class _AuditedScheme:
    """A scheme with its decoys; ``pool_of_owners`` where it is there to compare with."""

    scheme: Scheme
    source: DecoySource
    pool_of_owners: bool
    contract: Contract | None


def _schemes(plan: AuditPlan, source: DecoySource, population: Population) -> list[_AuditedScheme]:
    """The schemes to audit, and those to compare them with."""
    strategy, dims, axes = plan.strategy, plan.dims, plan.axes
    if plan.contract is not None:
        binding = plan.contract.binding
        strategy, dims, axes = binding.strategy, (binding.m,), binding.axes
    if isinstance(source, DecoyGenerator):
        source = source.reduced(axes or source.axes_for(DEFAULT_SHARE))
    kind = POOLED if isinstance(source, DecoyPool) else GENERATED
    decoys = kind if strategy.needs_decoys else None
    on = source.k if source.k < source.n else None
    schemes = [
        _AuditedScheme(Scheme(strategy, decoys, m, on), source, False, plan.contract) for m in dims
    ]
    if plan.comparison and decoys == GENERATED:
        pool = owners_pool(population, source.made_with)
        schemes += [_AuditedScheme(Scheme(strategy, POOLED, m), pool, True, None) for m in dims]
    return schemes


def _require_strangers(pool: DecoyPool, population: Population) -> None:
    """Refuse a pool that holds photos of the victims: every attack would find them in it."""
    shown = np.concatenate([population.victims.enrolled, population.victims.fresh])
    if len(resembling(pool, shown, cosine=SAME_PHOTO)):
        raise AuditError(
            "the decoy pool holds photos of PEOPLE, and an attack would find the victims in it: "
            "give people who are not in the pool"
        )


def _operating_point(system: System) -> dict[str, Any]:
    return {
        "default_level": system.level.name,
        "levels": [level.to_json() for level in system.points.levels],
        "raw_thresholds": dict(system.raw_thresholds),
        "template_bytes": wire.encoded_size(system.templates.n, system.templates.m),
    }


def _settings(plan: AuditPlan, population: Population, decoys: DecoySource) -> dict[str, Any]:
    return {
        "victims": plan.victims,
        "decoy_owners": plan.owners,
        "attacker_faces": len(population.attacker),
        "calibration_people": len(set(population.names)),
        "calibration": "of the people" if plan.contract is None else "of the contract",
        "contract_id": None if plan.contract is None else plan.contract.contract_id,
        "decoy_source_id": decoys.source_id,
        "attempts": plan.attempts,
        "training_seconds": plan.training_seconds,
        "seed": plan.seed,
    }


def _attacks(
    plan: AuditPlan, system: System, setup: AttackSetup, population: Population, kind: str
) -> list[Callable[[], list[AttackOutcome]]]:
    """All attacks on a scheme, in the order of the report."""
    inverters: dict[str, Inverter] = {}
    guesser = cache(lambda: _informed(system, setup))
    seconds = plan.training_seconds

    def learned() -> list[AttackOutcome]:
        if seconds is None:
            return []
        inverter, outcomes = invert(system, seconds=seconds, seed=plan.seed)
        inverters["inverter"] = inverter
        return outcomes

    def holders() -> list[AttackOutcome]:
        guesses: dict[str, Guess] = {"foot-point": foot_points, ATTACK: guesser()}
        outcomes = guess_with_and_without_holder_keys(system, guesses | inverters)
        return outcomes + guess_from_few_decoys(system)

    return [
        lambda: second_moments_attack(system, setup, kind=kind),
        lambda: template_attacks(system),
        learned,
        holders,
        lambda: several_templates(system, population.albums, guesser()),
        lambda: link(system, liftings=2, most_people=LINKED),
        lambda: renew(system, guesses={ATTACK: guesser()(system.templates)}),
        lambda: climb_victims(
            system.first(plan.climbed), most_attempts=plan.attempts, seed=plan.seed
        ),
    ]


def _informed(system: System, setup: AttackSetup) -> Guesser:
    """The guess of the attacker with all faces, of those that know no victim's moments."""
    return Guesser(replace(system, attacker=system.source.project(setup.counted[-1][1])))
