"""The audit of templates: every attack on a template that we know, on people with photos."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from attacks.chosen_enrollment import chosen_enrollment
from attacks.comparer import link_by_comparer
from attacks.databases import link_databases
from attacks.decision_walk import VICTIMS, reconstruct_from_decisions
from attacks.errors import AuditError
from attacks.further_faces import SAME_PHOTO, FurtherFaces, strangers_among
from attacks.hill_climbing import Ask, climb_service, dictionary_outcomes
from attacks.holder_keys import (
    Guess,
    guess_from_few_decoys,
    guess_with_and_without_holder_keys,
)
from attacks.learned import FaceCrops, invert, reconstruct
from attacks.learned.inverter import SECONDS, Inverter
from attacks.likelihood import (
    find_least_decoy_like,
    likeliest_guess,
    likeliest_guesses,
    simulate_unlimited,
)
from attacks.linkage import link
from attacks.outcomes import GENERATED, POOLED, AttackOutcome, Scheme
from attacks.population import LEAST_FITTED, Population, draw_population, without_decoy_people
from attacks.renewability import renew
from attacks.several_templates import several_templates
from attacks.stored import template_attacks
from attacks.stored.foot_point import foot_points
from attacks.system import System, enroll_victims, owners_pool
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.binding import embedding_id
from templates.contract.document import Contract
from templates.decoys import NOISE_ENERGY, DecoyGenerator, DecoyPool, DecoySource
from templates.space.lifting import Strategy
from verify.evaluation.attributes import resembling

LINKED = 120
"""Victims whose templates are linked across tenants: every two of them are compared."""

StartService = Callable[
    [Contract, DecoySource | None, Sequence[bytes]],
    AbstractContextManager[tuple[list[Ask], list[Ask]]],
]
"""Starts the service with a contract, decoys and templates (wire bytes); gives for each template
a ``probe → answer`` callable with scores, and one with decisions only."""


@dataclass(frozen=True, kw_only=True)
class AuditPlan:
    """What is attacked, and how hard.

    The contract of a service says its own scheme; without one, each of ``strategy`` and ``dims`` is
    calibrated on people who are not attacked. ``comparison`` adds templates with decoys of the
    ``owners``. ``training_seconds`` is for each network; None trains no inverter. ``decoy_faces``:
    the number of faces that the generator was fitted to, where it is known; without it, no
    attacker without limit is simulated.
    """

    strategy: Strategy = Strategy.ADVERSARIAL
    dims: tuple[int, ...] = ()
    contract: Contract | None = None
    victims: int = 300
    owners: int = 600
    comparison: bool = True
    climbed: int = 10
    attempts: int = 1000
    training_seconds: float | None = 120.0
    decoy_faces: int | None = None
    reconstruction: bool = False
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
    aligned: bool,
    start_service: StartService | None,
    further: Sequence[FurtherFaces] = (),
    progress: Callable[[float], None] = lambda _share: None,
) -> AuditResult:
    """Attack the templates of some people, under every scheme of a plan.

    Parameters
    ----------
    decoys
        What the service lifts with; None to fit a generator to people of no other group.
    start_service
        None where no service is attacked.
    further
        Faces that the attacker has beside those of ``faces``; the victims are left out.
    progress
        Called with the share that is done, which rises to 1.

    Raises
    ------
    AuditError
        There are too few people, or they are in the decoy pool.
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
    # Faces that the attacker has beside their own third: one of each person of no other part.
    known = population.attacker[:0]
    if decoys is None:
        fitted, population = without_decoy_people(population, seed=plan.seed)
        info = pack.info
        space = embedding_id(embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing)
        decoys = DecoyGenerator.fit(fitted, made_with=space, noise=NOISE_ENERGY / info.n)
        plan = replace(plan, decoy_faces=len(fitted))
    else:
        known = population.owners.enrolled
        if isinstance(decoys, DecoyPool):
            _require_strangers(decoys, population)
    beside = [
        strangers_among(more, faces.descriptors, identities, population.victims.shown)
        for more in further
    ]
    brought = np.concatenate([known[:0], *(more.descriptors for more in beside)])
    kind = " and ".join(["the audited set", *(more.name for more in beside)])
    schemes = _schemes(plan, decoys, population)
    crops = FaceCrops(pack, faces, aligned=aligned) if plan.reconstruction else None
    result = AuditResult(
        [],
        [],
        [str(audited.scheme) for audited in schemes if audited.pool_of_owners],
        {
            **_settings(plan, population, decoys, service=start_service is not None),
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
            pool_of_owners=audited.pool_of_owners,
            contract=audited.contract,
            seed=plan.seed,
        )
        result.schemes.append({**audited.scheme.to_json(), **_operating_point(system)})
        attacker_faces = brought if audited.pool_of_owners else np.concatenate([known, brought])
        informed = replace(system, attacker=np.concatenate([system.attacker, attacker_faces]))
        attacks = _attacks(plan, system, informed, population, faces, crops, start_service, kind)
        for done, attack in enumerate(attacks, start=1):
            result.outcomes.extend(attack())
            progress((number + done / len(attacks)) / len(schemes))
    return result


@dataclass(frozen=True, eq=False)
class _AuditedScheme:
    """A scheme with its decoys; ``pool_of_owners`` where it is there to compare with."""

    scheme: Scheme
    source: DecoySource
    pool_of_owners: bool
    contract: Contract | None


def _schemes(plan: AuditPlan, source: DecoySource, population: Population) -> list[_AuditedScheme]:
    """The schemes to audit, and those to compare them with."""
    strategy, dims = plan.strategy, plan.dims
    if plan.contract is not None:
        strategy, dims = plan.contract.binding.strategy, (plan.contract.binding.m,)
    kind = POOLED if isinstance(source, DecoyPool) else GENERATED
    decoys = kind if strategy.needs_decoys else None
    schemes = [
        _AuditedScheme(Scheme(strategy, decoys, m), source, False, plan.contract) for m in dims
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


def _settings(
    plan: AuditPlan, population: Population, decoys: DecoySource, *, service: bool
) -> dict[str, Any]:
    return {
        "victims": plan.victims,
        "decoy_owners": plan.owners,
        "attacker_faces": len(population.attacker),
        "calibration_people": len(set(population.names)),
        "calibration": "of the people" if plan.contract is None else "of the contract",
        "contract_id": None if plan.contract is None else plan.contract.contract_id,
        "decoy_source_id": decoys.source_id,
        "decoy_faces": plan.decoy_faces,
        "service": service,
        "attempts": plan.attempts if service else None,
        "training_seconds": plan.training_seconds,
        "reconstruction": plan.reconstruction,
        "seed": plan.seed,
    }


def _attacks(
    plan: AuditPlan,
    system: System,
    informed: System,
    population: Population,
    faces: Extraction,
    crops: FaceCrops | None,
    start_service: StartService | None,
    kind: str,
) -> list[Callable[[], list[AttackOutcome]]]:
    """All attacks on a scheme, in the order of the report; ``informed`` has all known faces."""
    inverters: dict[str, Inverter] = {}
    likeliest = cache(lambda: likeliest_guesses(informed))
    seconds = plan.training_seconds

    def likelihood() -> list[AttackOutcome]:
        outcomes = find_least_decoy_like(informed, likeliest(), kind=kind)
        return outcomes + simulate_unlimited(
            informed, kind=kind, fitted_to=plan.decoy_faces, measured=outcomes
        )

    def learned() -> list[AttackOutcome]:
        if seconds is None:
            return []
        inverter, outcomes = invert(informed, seconds=seconds, seed=plan.seed)
        inverters["inverter"] = inverter
        return outcomes

    def holders() -> list[AttackOutcome]:
        guesses: dict[str, Guess] = {
            "foot-point": foot_points,
            "decoy-likelihood": likeliest_guess(informed),
        }
        outcomes = guess_with_and_without_holder_keys(system, guesses | inverters)
        return outcomes + guess_from_few_decoys(informed)

    def drawn() -> list[AttackOutcome]:
        if crops is None:
            return []
        guesses = dict(likeliest())
        for name, inverter in inverters.items():
            guesses[name] = inverter(system.templates)
        return reconstruct(
            system,
            crops.of(population.rows),
            faces.descriptors[population.rows],
            crops.of(system.victims.shown),
            embed=crops.embed,
            guesses=guesses,
            seconds=SECONDS if seconds is None else seconds,
            seed=plan.seed,
        )

    def climbs() -> list[AttackOutcome]:
        if start_service is None:
            return []
        templates = [
            wire.encode(template, contract_id=system.contract.contract_id)
            for template in system.templates[: plan.climbed]
        ]
        with start_service(system.contract, system.source, templates) as (scored, deciding):
            return climb_service(
                system, scored, deciding, most_attempts=plan.attempts, seed=plan.seed
            )

    return [
        likelihood,
        lambda: template_attacks(system),
        learned,
        holders,
        lambda: several_templates(system, population.albums, likeliest_guess(informed)),
        drawn,
        lambda: link(system, liftings=3, most_people=LINKED),
        lambda: link_by_comparer(system, population.mates),
        lambda: link_databases(system, most_people=LINKED),
        lambda: renew(system, guesses=likeliest()),
        lambda: chosen_enrollment(system),
        lambda: dictionary_outcomes(system),
        lambda: reconstruct_from_decisions(system.first(VICTIMS)),
        climbs,
    ]
