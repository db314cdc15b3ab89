"""The audit of templates: every attack on a template that we know, on people with photos."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.cast import LEAST_FITTED, Cast, make_cast, without_decoy_people
from attacks.chosen_enrollment import chosen_enrollment
from attacks.databases import link_databases
from attacks.dictionary import dictionary_outcomes
from attacks.errors import AuditError
from attacks.hill_climbing import Ask, climb_service
from attacks.learned import FaceCrops, invert, reconstruct
from attacks.learned.inverter import SECONDS, Inverter
from attacks.likelihood import find_least_decoy_like, likeliest_guesses
from attacks.linkage import link
from attacks.outcomes import GENERATED, POOLED, Outcome, Scheme
from attacks.renewability import renew
from attacks.scene import Scene, owners_pool, stage
from attacks.stored import template_attacks
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.binding import embedding_id
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.space.lifting import Strategy
from verify.evaluation.attributes import resembling

SAME_PHOTO = 0.999
"""Cosine from which two embeddings are of one photo."""
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

    Parameters
    ----------
    strategy, dims
        The schemes that are audited, where no contract says them.
    contract
        Of the service that is audited; None to calibrate on people who are not attacked.
    victims, owners
        How many people are attacked, and make up the pool of real decoys that is compared with.
    comparison
        Whether templates with decoys of real people are attacked too.
    climbed, attempts
        Victims that are climbed towards over the service, and most attempts on each.
    training_seconds
        For each network; None to train no inverter.
    reconstruction
        Whether faces are drawn from templates.
    seed
        Of all that is random.
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
    reconstruction: bool = False
    seed: int = 0


@dataclass(frozen=True)
class AuditResult:
    """What an audit found.

    Parameters
    ----------
    outcomes
        Of all attacks on all schemes.
    schemes
        What each scheme costs: error rates of its calibration, and the size of a template.
    comparisons
        Names of the schemes that are there to compare with.
    settings
        What was audited, for the report.
    """

    outcomes: list[Outcome]
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
    progress: Callable[[float], None] = lambda _share: None,
) -> AuditResult:
    """Attack the templates of some people, under every scheme of a plan.

    Parameters
    ----------
    faces, identities
        Embedded photos, and the name of the person on each.
    decoys
        What the service lifts with; None to fit a generator to people who play no other part.
    aligned
        Whether the photos are aligned crops.
    start_service
        None where no service is attacked.
    progress
        Called with the share that is done, which rises to 1.

    Raises
    ------
    AuditError
        There are too few people, or they are in the decoy pool.
    """
    cast = make_cast(
        faces.descriptors, identities, victims=plan.victims, owners=plan.owners, seed=plan.seed
    )
    if len(cast.attacker) < 2 * LEAST_FITTED:
        raise AuditError(
            f"the attacker has {len(cast.attacker)} faces, a third of the people who are neither "
            f"victims nor decoy owners, and needs {2 * LEAST_FITTED}: ask for fewer victims and "
            "decoy owners, or give a larger folder"
        )
    # Faces that the attacker has beside their own third: one of each person of no other part.
    known = cast.attacker[:0]
    if decoys is None:
        fitted, cast = without_decoy_people(cast, seed=plan.seed)
        info = pack.info
        space = embedding_id(embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing)
        decoys = DecoyGenerator.fit(fitted, made_with=space)
    else:
        known = cast.owners.enrolled
        if isinstance(decoys, DecoyPool):
            _require_strangers(decoys, cast)
    schemes = _schemes(plan, decoys, cast)
    crops = FaceCrops(pack, faces, aligned=aligned) if plan.reconstruction else None
    result = AuditResult(
        [],
        [],
        [str(each.scheme) for each in schemes if each.pool_of_owners],
        _settings(plan, cast, decoys, service=start_service is not None),
    )
    progress(0.0)
    for number, each in enumerate(schemes):
        scene = stage(
            cast,
            each.scheme,
            each.source,
            embedder_sha256=pack.info.embedder_sha256,
            preprocessing=pack.info.preprocessing,
            pool_of_owners=each.pool_of_owners,
            contract=each.contract,
            seed=plan.seed,
        )
        result.schemes.append({**each.scheme.to_json(), **_operating_point(scene)})
        own = known[:0] if each.pool_of_owners else known
        attacks = _attacks(plan, scene, cast, faces, own, crops, start_service)
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


def _schemes(plan: AuditPlan, source: DecoySource, cast: Cast) -> list[_AuditedScheme]:
    """The schemes to audit, and those to compare them with."""
    strategy, dims = plan.strategy, plan.dims
    if plan.contract is not None:
        strategy, dims = plan.contract.binding.strategy, (plan.contract.binding.m,)
    kind = POOLED if isinstance(source, DecoyPool) else GENERATED
    decoys = kind if strategy is not Strategy.RANDOM else None
    schemes = [
        _AuditedScheme(Scheme(strategy, decoys, m), source, False, plan.contract) for m in dims
    ]
    if plan.comparison and decoys == GENERATED:
        pool = owners_pool(cast, source.made_with)
        schemes += [_AuditedScheme(Scheme(strategy, POOLED, m), pool, True, None) for m in dims]
    return schemes


def _require_strangers(pool: DecoyPool, cast: Cast) -> None:
    """Refuse a pool that holds photos of the victims: every attack would find them in it."""
    shown = np.concatenate([cast.victims.enrolled, cast.victims.fresh])
    if len(resembling(pool, shown, cosine=SAME_PHOTO)):
        raise AuditError(
            "the decoy pool holds photos of PEOPLE, and an attack would find the victims in it: "
            "give people who are not in the pool"
        )


def _operating_point(scene: Scene) -> dict[str, Any]:
    return {
        "default_level": scene.level.name,
        "levels": [level.to_json() for level in scene.points.levels],
        "raw_thresholds": dict(scene.raw_thresholds),
        "template_bytes": wire.encoded_size(scene.templates.n, scene.templates.m),
    }


def _settings(plan: AuditPlan, cast: Cast, decoys: DecoySource, *, service: bool) -> dict[str, Any]:
    return {
        "victims": plan.victims,
        "decoy_owners": plan.owners,
        "attacker_faces": len(cast.attacker),
        "calibration_people": len(set(cast.names)),
        "calibration": "of the people" if plan.contract is None else "of the contract",
        "contract_id": None if plan.contract is None else plan.contract.contract_id,
        "decoy_source_id": decoys.source_id,
        "service": service,
        "attempts": plan.attempts if service else None,
        "training_seconds": plan.training_seconds,
        "reconstruction": plan.reconstruction,
        "seed": plan.seed,
    }


def _attacks(
    plan: AuditPlan,
    scene: Scene,
    cast: Cast,
    faces: Extraction,
    known: NDArray[np.float32],
    crops: FaceCrops | None,
    start_service: StartService | None,
) -> list[Callable[[], list[Outcome]]]:
    """All attacks on a scheme, in the order of the report."""
    inverters: list[Inverter] = []
    likeliest = cache(lambda: likeliest_guesses(scene, known))
    seconds = plan.training_seconds

    def learned() -> list[Outcome]:
        if seconds is None:
            return []
        inverter, outcomes = invert(scene, known, seconds=seconds, seed=plan.seed)
        inverters.append(inverter)
        return outcomes

    def drawn() -> list[Outcome]:
        if crops is None:
            return []
        guesses = dict(likeliest())
        for inverter in inverters:
            guesses["inverter"] = inverter(scene.templates)
        return reconstruct(
            scene,
            crops.of(cast.rows),
            faces.descriptors[cast.rows],
            crops.of(scene.victims.shown),
            embed=crops.embed,
            guesses=guesses,
            seconds=SECONDS if seconds is None else seconds,
            seed=plan.seed,
        )

    def climbs() -> list[Outcome]:
        if start_service is None:
            return []
        templates = [
            wire.encode(template, contract_id=scene.contract.contract_id)
            for template in scene.templates[: plan.climbed]
        ]
        with start_service(scene.contract, scene.source, templates) as (scored, deciding):
            return climb_service(
                scene, scored, deciding, most_attempts=plan.attempts, seed=plan.seed
            )

    return [
        lambda: find_least_decoy_like(scene, known, guesses=likeliest()),
        lambda: template_attacks(scene, photos=cast.albums),
        learned,
        drawn,
        lambda: link(scene, liftings=3, most_people=LINKED),
        lambda: link_databases(scene, most_people=LINKED),
        lambda: renew(scene, photos=cast.albums, guesses=likeliest()),
        lambda: chosen_enrollment(scene),
        lambda: dictionary_outcomes(scene),
        climbs,
    ]
