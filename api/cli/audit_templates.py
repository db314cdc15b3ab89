"""``veilface audit templates``: every attack on a template that we know, on people with photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from api.cli.audit_attacks import PARTS, Drawings, attacks_on, operating
from api.cli.audit_report import Out, Seed, conclude, default_of, limit_option
from api.cli.console import demo_notice, message, progress
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import CommandError, UsageError, require_extra
from api.cli.evaluation_inputs import listed
from api.cli.options import AsJson, takes_settings
from api.process.opening import file_sealer, open_keyring
from api.process.preparation import (
    DEFAULT_DIM,
    acquired_json,
    made_with,
    recorded_of,
    require_made_with,
)
from api.settings import Settings
from attacks.cast import Cast, make_cast, without_decoy_people
from attacks.learned.extra import need
from attacks.outcomes import GENERATED, POOLED, Outcome, Scheme
from attacks.report import document
from attacks.scene import owners_pool, stage
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoyPool, DecoySource, load_source
from templates.keys.sealing import Sealer
from templates.space.lifting import Strategy
from verify import labelled_folder
from verify.evaluation.attributes import resembling

FITTED_FACES = 100
"""Least that a decoy generator is fitted to: the decoy owners, and half of the attacker's faces."""
SAME_PHOTO = 0.999
"""Cosine from which two descriptors are of one photo."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(templates)


@takes_settings(*BULK)
def templates(
    people: Annotated[
        Path,
        typer.Argument(
            metavar="PEOPLE",
            help="Labelled faces: one subfolder for each person, with photos in it (as LFW has "
            "them). Victims and decoy owners need two photos or more.",
            show_default=False,
        ),
    ],
    *,
    settings: Settings,
    decoys: Annotated[
        Path | None,
        typer.Option(
            help="The file of `decoys build` that the service uses. Unset: `decoys.veil` in "
            "`data_dir`.",
            show_default=False,
        ),
    ] = None,
    fit_decoys: Annotated[
        bool,
        typer.Option(
            "--fit-decoys",
            help="Fit the decoys to people of PEOPLE who play no other part, in place of --decoys: "
            "what decoys of the same kind of people and photos would give.",
        ),
    ] = False,
    contract: Annotated[
        Path | None,
        typer.Option(
            help="Audit the service of this contract: its strategy, dimension, thresholds and "
            "cohort. Unset: each scheme is calibrated on people of PEOPLE who are not attacked.",
            show_default=False,
        ),
    ] = None,
    strategy: Annotated[
        Strategy | None,
        typer.Option(
            help="How templates are lifted; not with --contract. Unset: adversarial.",
            show_default=False,
        ),
    ] = None,
    dim: Annotated[
        str | None,
        typer.Option(
            help="Dimensions m of templates, such as 16,32; not with --contract. Unset: "
            f"{DEFAULT_DIM}.",
            show_default=False,
        ),
    ] = None,
    victims: Annotated[int, typer.Option(min=20, help="People who are attacked.")] = 300,
    owners: Annotated[
        int,
        typer.Option(
            min=FITTED_FACES,
            help="People who make up the pool of real decoys that is compared with.",
        ),
    ] = 600,
    comparison: Annotated[
        bool,
        typer.Option(
            help="Attack templates with decoys of real people too, to compare with and to show "
            "that the attacks work."
        ),
    ] = True,
    service: Annotated[
        bool,
        typer.Option(help="Start the service, and climb towards a victim over its REST interface."),
    ] = True,
    climbed: Annotated[
        int, typer.Option(min=1, help="Victims that climbers attack over the REST interface.")
    ] = 10,
    attempts: Annotated[
        int, typer.Option(min=50, help="Most attempts of a climber on one victim.")
    ] = 1000,
    learned: Annotated[
        bool | None,
        typer.Option(
            "--learned/--no-learned",
            help="Train an inverter from template to embedding (needs the extra `torch`). Unset: "
            "where torch is installed.",
            show_default=False,
        ),
    ] = None,
    training_seconds: Annotated[
        float, typer.Option(min=1, help="Most seconds of training, for each network.")
    ] = 120.0,
    reconstruction: Annotated[
        bool,
        typer.Option(
            "--reconstruct",
            help="Train a decoder from embedding to face picture on the people who are not "
            "attacked, and try to reconstruct the victims' faces. No picture is written.",
        ),
    ] = False,
    max_foot_point_success: Annotated[float, limit_option("foot-point-success")] = default_of(
        "foot-point-success"
    ),
    max_recovery_success: Annotated[float, limit_option("recovery-success")] = default_of(
        "recovery-success"
    ),
    max_linkability: Annotated[float, limit_option("linkability")] = default_of("linkability"),
    max_renewed_success: Annotated[float, limit_option("renewed-success")] = default_of(
        "renewed-success"
    ),
    max_false_acceptance: Annotated[float, limit_option("false-acceptance")] = default_of(
        "false-acceptance"
    ),
    max_climbing_success: Annotated[float, limit_option("climbing-success")] = default_of(
        "climbing-success"
    ),
    max_success_with_templates: Annotated[
        float, limit_option("success-with-templates")
    ] = default_of("success-with-templates"),
    max_success_with_key: Annotated[float, limit_option("success-with-key")] = default_of(
        "success-with-key"
    ),
    seed: Seed = 0,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
    out: Out = Path("audit-templates"),
    as_json: AsJson = False,
) -> None:
    """Attack private templates: inversion, linkage, renewal, impersonation, climbing.

    Writes report.json, report.md and figures to --out. Every attack says what the attacker is
    assumed to have. Exit status 1: an attack exceeds its limit. docs/privacy.md explains them.

    Example: `veilface audit templates lfw --pack buffalo_l --decoys decoys.veil --out audit`
    """
    require_extra("audit")
    if fit_decoys and (decoys is not None or contract is not None):
        raise UsageError("--fit-decoys fits decoys of its own: give no --decoys and no --contract")
    if learned or reconstruction:
        need("torch")
    train = find_spec("torch") is not None if learned is None else learned
    if not train:
        message("note: no inverter is trained: torch is not installed, or --no-learned is set")
    pack = bulk_pack(settings, flip=flip, why="an audit attacks embeddings of a model pack")
    sealer = file_sealer(open_keyring(settings))
    loaded = None if contract is None else Contract.load(contract, sealer)
    if contract is not None and (strategy is not None or dim is not None):
        raise UsageError(
            "a contract says its strategy and dimension: leave out --strategy and --dim"
        )
    chosen = Strategy.ADVERSARIAL if strategy is None else strategy
    asked = str(DEFAULT_DIM) if dim is None else dim
    dims = tuple(dict.fromkeys(listed(asked, int, "--dim", expected="whole numbers such as 16,32")))
    _require_dims(dims, pack)
    given = None if fit_decoys else _decoys(decoys or settings.resolved_decoys_file, sealer, pack)
    if loaded is not None and given is not None:
        loaded.binding.require_source(source_id=given.source_id, made_with=given.made_with)
    labelled = labelled_folder(people)
    name_of = dict(zip(labelled.paths, labelled.identities, strict=True))
    faces = extract(pack, labelled.paths, aligned=aligned, settings=settings, cache=cache)
    cast = make_cast(
        faces.descriptors,
        [name_of[path] for path in faces.paths],
        victims=victims,
        owners=owners,
        seed=seed,
    )
    if len(cast.attacker) < 2 * FITTED_FACES:
        raise CommandError(
            f"the attacker has {len(cast.attacker)} faces, a third of the people who are neither "
            f"victims nor decoy owners, and needs {2 * FITTED_FACES}: ask for fewer with "
            "--victims and --owners, or give a larger folder"
        )
    if isinstance(given, DecoyPool):
        _require_strangers(given, cast)
    # Faces that the attacker has beside their own third: one of each person of no other part.
    known = cast.attacker[:0]
    if given is None:
        fitted, cast = without_decoy_people(cast, seed=seed)
        source: DecoySource = DecoyGenerator.fit(fitted, made_with=made_with(pack))
    else:
        source = given
        known = cast.owners.enrolled
    targets = _targets(
        source, cast, strategy=chosen, dims=dims, contract=loaded, comparison=comparison
    )
    drawings = Drawings(pack, faces, aligned=aligned) if reconstruction else None
    outcomes: list[Outcome] = []
    schemes: list[dict[str, Any]] = []
    with progress("auditing", PARTS * len(targets)) as advance:
        for target in targets:
            scene = stage(
                cast,
                target.scheme,
                target.source,
                embedder_sha256=pack.info.embedder_sha256,
                preprocessing=pack.info.preprocessing,
                pool_of_owners=target.pool_of_owners,
                contract=target.contract,
                seed=seed,
            )
            schemes.append({**target.scheme.to_json(), **operating(scene)})
            for attack in attacks_on(
                scene,
                cast,
                known[:0] if target.pool_of_owners else known,
                seconds=training_seconds if train else None,
                attempts=attempts if service else None,
                climbed=climbed,
                drawings=drawings,
                seed=seed,
            ):
                outcomes += attack()
                advance(1)
    report = document(
        "templates",
        outcomes=outcomes,
        limits={
            "foot-point-success": max_foot_point_success,
            "recovery-success": max_recovery_success,
            "linkability": max_linkability,
            "renewed-success": max_renewed_success,
            "false-acceptance": max_false_acceptance,
            "climbing-success": max_climbing_success,
            "success-with-templates": max_success_with_templates,
            "success-with-key": max_success_with_key,
        },
        comparisons=[str(each.scheme) for each in targets if each.pool_of_owners],
        model={**recorded_of(pack), "embedder_sha256": pack.info.embedder_sha256},
        settings={
            "people": labelled.root.resolve().name,
            "victims": victims,
            "decoy_owners": owners,
            "attacker_faces": len(cast.attacker),
            "calibration_people": len(set(cast.names)),
            "calibration": "of the people" if loaded is None else "of the contract",
            "contract_id": None if loaded is None else loaded.contract_id,
            "decoy_source_id": source.source_id,
            "service": service,
            "attempts": attempts if service else None,
            "training_seconds": training_seconds if train else None,
            "reconstruction": reconstruction,
            "fit_decoys": fit_decoys,
            "flip": flip,
            "seed": seed,
        },
        schemes=schemes,
        failure_to_acquire=acquired_json(faces),
    )
    conclude(
        report, out, as_json=as_json,
        notice=demo_notice(pack.info.embedder_sha256, n=pack.info.n),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Target:
    """A scheme with its decoys."""

    scheme: Scheme
    source: DecoySource
    pool_of_owners: bool
    contract: Contract | None


def _targets(
    source: DecoySource,
    cast: Cast,
    *,
    strategy: Strategy,
    dims: Sequence[int],
    contract: Contract | None,
    comparison: bool,
) -> list[_Target]:
    """The schemes to audit, and those to compare them with."""
    if contract is not None:
        strategy, dims = contract.binding.strategy, (contract.binding.m,)
    kind = POOLED if isinstance(source, DecoyPool) else GENERATED
    chosen = kind if strategy is not Strategy.RANDOM else None
    targets = [_Target(Scheme(strategy, chosen, m), source, False, contract) for m in dims]
    if comparison and kind == GENERATED and strategy is not Strategy.RANDOM:
        pool = owners_pool(cast, source.made_with)
        targets += [_Target(Scheme(strategy, POOLED, m), pool, True, None) for m in dims]
    return targets


def _decoys(file: Path, sealer: Sealer, pack: ModelPack) -> DecoySource:
    source = load_source(file, sealer)
    if source.n != pack.info.n:
        raise CommandError(
            f"the decoys have {source.n} numbers each, the pack gives {pack.info.n}; build the "
            "decoys with this pack"
        )
    require_made_with(source, pack)
    return source


def _require_strangers(pool: DecoyPool, cast: Cast) -> None:
    """Refuse a pool that holds photos of the victims: every attack would find them in it."""
    shown = np.concatenate([cast.victims.enrolled, cast.victims.fresh])
    if len(resembling(pool, shown, cosine=SAME_PHOTO)):
        raise CommandError(
            "the decoy pool holds photos of PEOPLE, and an attack would find the victims in it: "
            "give people who are not in the pool"
        )


def _require_dims(dims: Sequence[int], pack: ModelPack) -> None:
    wrong = [m for m in dims if not 1 <= m < pack.info.n]
    if wrong:
        raise UsageError(f"--dim takes dimensions from 1 to {pack.info.n - 1}, not {wrong[0]}")
