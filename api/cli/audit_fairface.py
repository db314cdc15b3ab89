"""``veilface audit fairface``: what templates tell about gender, race and age."""

from pathlib import Path
from typing import Annotated

import typer

from api.cli.audit_report import (
    FAIRFACE_LIMITS,
    Limits,
    Out,
    Seed,
    limits_of,
    model_json,
    reported,
    served_scheme,
)
from api.cli.console import share_done
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import UsageError, require_extra
from api.cli.inputs import fairface_labels, listed, listed_dims, load_decoys
from api.cli.options import DEFAULT_DIM, PROCESSOR, Device, chosen_device, quick
from api.cli.results import Plan, Result, reports
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from attacks.attributes.audit import (
    attribute_outcomes,
    default_lifting,
    labelled_faces,
    run_attribute_audit,
)
from attacks.attributes.neighbours import K
from attacks.attributes.plan import OUR_DIMS, PAPER_DIMS, AttributePlan, schemes_of
from attacks.outcomes import GENERATED, RAW, Scheme
from attacks.report import document
from models.pack import ModelPack
from templates.contract.document import Binding
from templates.decoys import DecoyGenerator
from templates.decoys.fitting import MIN_DESCRIPTORS
from templates.distances import on_device
from templates.space.lifting import Strategy
from verify.preparation import acquired_json

STRATEGIES = (
    RAW,
    Strategy.RANDOM,
    Strategy.ADVERSARIAL,
    Strategy.HYBRID,
    Strategy.HYBRID_PLUS,
)


@reports(*BULK)
def fairface(
    root: Annotated[
        Path,
        typer.Argument(
            metavar="ROOT",
            help="FairFace: a folder with its two label files and the photos that they name.",
        ),
    ],
    *,
    settings: Settings,
    lifting: Annotated[
        int | None,
        typer.Option(
            min=MIN_DESCRIPTORS,
            help="Training faces that are the lifting database. Unset: the paper's 10,000, or "
            "three tenths of a smaller training set.",
        ),
    ] = None,
    attack: Annotated[
        int | None,
        typer.Option(min=100, help="Most training faces that the attacker has. Unset: all others."),
    ] = None,
    attacked: Annotated[
        int | None,
        typer.Option(
            min=50, help="Most validation faces that are attacked. Unset: all.", show_default=False
        ),
    ] = None,
    strategy: Annotated[
        str, typer.Option(help="Strategies with the decoys of the lifting database.")
    ] = ",".join(STRATEGIES),
    dim: Annotated[str, typer.Option(help="Their dimensions m.")] = ",".join(map(str, PAPER_DIMS)),
    generated_dim: Annotated[
        str,
        typer.Option(
            help="Dimensions of adversarial lifting with generated decoys, beside --service-dim."
        ),
    ] = ",".join(map(str, OUR_DIMS)),
    decoys: Annotated[
        Path | None,
        typer.Option(
            help="The service's decoy generator. Unset: `decoys.veil` in `data_dir` where it is "
            "of this pack, else one fitted to the lifting database."
        ),
    ] = None,
    axes: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Axes that embeddings are projected on for generated decoys. Unset: those of the "
            "contract, else all.",
        ),
    ] = None,
    service_dim: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Dimension, with generated decoys, that the verdict is on; other schemes are "
            f"compared with it. Unset: that of the contract, else {DEFAULT_DIM}.",
        ),
    ] = None,
    seed: Seed = 0,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
    device: Device = PROCESSOR,
    limit: Limits = None,
    out: Out = Path("audit-fairface"),
    _quick: Annotated[
        bool, quick(lifting=300, attack=700, attacked=300, dim="4,16", generated_dim="16,64")
    ] = False,
    _plan: Plan = None,
) -> Result:
    """Infer gender, race and age from templates: the paper's experiment, and stronger attackers.

    Writes report.json, report.md and figures, the paper's among them, to --out. "The contract" is
    that in `data_dir` where it is of these decoys. Exit status 1: the strongest attacker exceeds
    the limit; 3: none does, and too few faces show it.
    docs/privacy.md explains every figure.

    Example: `veilface audit fairface fairface --pack buffalo_l --out audit`
    """
    require_extra("audit")
    limits = limits_of(limit, FAIRFACE_LIMITS)
    torch_device = chosen_device(device)
    pack = bulk_pack(settings, flip=flip, why="an audit attacks embeddings of a model pack")
    places = listed(
        strategy,
        STRATEGIES.index,
        "--strategy",
        expected=f"a list of {', '.join(STRATEGIES)}",
    )
    generator, served = _deployed(decoys, settings, pack)
    if served is not None:
        axes, service_dim = axes or served.axes, service_dim or served.m
    service_dim = service_dim or DEFAULT_DIM
    if generator is not None:
        generator = generator.reduced(axes or generator.k)
    n = axes or pack.info.n
    ours = listed_dims(generated_dim, "--generated-dim", n=n, example="16,32")
    if service_dim >= n:
        raise UsageError(f"--service-dim must be below the {n} numbers of what is lifted")
    schemes = schemes_of(
        strategies=[STRATEGIES[one] for one in sorted({*places}) if STRATEGIES[one] != RAW],
        dims=listed_dims(dim, "--dim", n=pack.info.n, example="2,4"),
        generated_dims=tuple(dict.fromkeys((*ours, service_dim))),
        axes=axes,
    )
    audited = Scheme(str(Strategy.ADVERSARIAL), GENERATED, service_dim, axes)
    labels = fairface_labels(root, "train"), fairface_labels(root, "val")
    plan = AttributePlan(
        schemes=schemes,
        lifting=default_lifting(len(labels[0])) if lifting is None else lifting,
        attack=attack,
        attacked=attacked,
        axes=axes,
        seed=seed,
    )
    plan.attacker_faces(len(labels[0]))
    photos, faces = [], []
    for part in plan.sample(*labels):
        extraction = extract(pack, list(part), aligned=aligned, settings=settings, cache=cache)
        photos.append(extraction)
        faces.append(labelled_faces(extraction, part))
    with share_done("attacking templates") as report_share, on_device(torch_device):
        rows, parts = run_attribute_audit(plan, *faces, generator=generator, progress=report_share)
    report = document(
        "fairface",
        outcomes=attribute_outcomes(rows, audited=audited),
        rows=[row.to_json() for row in rows],
        limits=limits,
        model=model_json(pack),
        settings={
            "root": root.resolve().name,
            "lifting": len(parts.lifting),
            "attack": len(parts.attack),
            "attacked": len(parts.attacked),
            "k": K,
            "decoys": "of the lifting faces" if generator is None else generator.source_id,
            "audited": str(audited),
            "flip": flip,
            "device": device,
            "seed": seed,
        },
        failure_to_acquire={"train": acquired_json(photos[0]), "val": acquired_json(photos[1])},
    )
    return reported(report, out, pack)


def _deployed(
    decoys: Path | None, settings: Settings, pack: ModelPack
) -> tuple[DecoyGenerator | None, Binding | None]:
    """Return the service's generator, and its scheme where the contract is of these decoys.

    Neither is needed: without a generator the audit fits one.
    """
    path = decoys or settings.resolved_decoys_file
    if decoys is None and not path.is_file():
        return None, None
    sealer = file_sealer(open_keyring(settings))
    source = load_decoys(path, sealer, pack)
    if not isinstance(source, DecoyGenerator):
        raise UsageError(f"{path.name} is a decoy pool; --decoys takes a generator")
    return source, served_scheme(settings, sealer, source)
