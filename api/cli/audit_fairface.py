"""``veilface audit fairface``: what templates tell about gender, race and age."""

from pathlib import Path
from typing import Annotated

import typer

from api.cli import flags
from api.cli.audit_report import Limits, Out, limits_of, reported
from api.cli.bulk import BULK, Bulk, listed, listed_numbers
from api.cli.console import share_done
from api.cli.errors import UsageError, require_extra
from api.cli.options import PROCESSOR, Plan, reports, torch_device
from api.cli.results import Result
from api.settings import Settings
from attacks.attributes.audit import (
    attribute_outcomes,
    default_lifting,
    labelled_faces,
    run_attribute_audit,
)
from attacks.attributes.neighbours import K
from attacks.attributes.plan import OUR_DIMS, PAPER_DIMS, AttributePlan, schemes_of
from attacks.outcomes import GENERATED, Scheme
from attacks.report import document
from templates.contract.binding import MAX_M
from templates.decoys import DecoyGenerator
from templates.decoys.fitting import MIN_DESCRIPTORS
from templates.distances import on_device
from templates.space.lifting import Strategy
from verify.fairface_labels import read_labels
from verify.preparation import acquired_json

STRATEGIES = (Strategy.RANDOM, Strategy.ADVERSARIAL, Strategy.HYBRID, Strategy.HYBRID_PLUS)


@reports(*BULK)
def fairface(
    root: Annotated[Path, typer.Argument(help="FairFace: two label files, and their photos.")],
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
        int | None, typer.Option(min=50, help="Most faces that are attacked. Unset: all.")
    ] = None,
    strategy: Annotated[
        str, typer.Option(help="Strategies with the decoys of the lifting database.")
    ] = ",".join(STRATEGIES),
    dim: Annotated[str, typer.Option(help="Their dimensions m.")] = ",".join(map(str, PAPER_DIMS)),
    generated_dim: Annotated[
        str, typer.Option(help="Dimensions with generated decoys, beside the contract's.")
    ] = ",".join(map(str, OUR_DIMS)),
    decoys: flags.Decoys = None,
    seed: flags.Seed = 0,
    aligned: flags.Aligned = False,
    flip: flags.Flip = False,
    cache: flags.Cache = None,
    device: flags.Device = PROCESSOR,
    limit: Limits = None,
    out: Out = Path("audit-fairface"),
    _plan: Plan = None,
) -> Result:
    """Infer gender, race and age from templates: the paper's experiment, and stronger attackers.

    Writes report.json, report.md and figures, the paper's among them, to --out. The verdict is on
    the scheme of the contract in `data_dir` where it is of these decoys, else on the last of
    --generated-dim. Exit status 1: the strongest attacker exceeds the limit; 3: none does, and too
    few faces show it. Where there are no decoys, some are fitted to the lifting database.

    Example: `veilface audit fairface fairface --pack buffalo_l --out audit`
    """
    require_extra("audit")
    limits = limits_of(limit)
    on = torch_device(device)
    bulk = Bulk(settings, aligned=aligned, flip=flip, cache_file=cache)
    named = listed(strategy, Strategy, "--strategy", expected=f"a list of {', '.join(STRATEGIES)}")
    generator, axes = None, None
    service_dims: tuple[int, ...] = ()
    if decoys is not None or settings.resolved_decoys_file.is_file():
        source = bulk.decoys(decoys)
        if not isinstance(source, DecoyGenerator):
            file = decoys or settings.resolved_decoys_file
            raise UsageError(f"{file} is a pool: name the file of a generator by --decoys")
        generator = source
        if (served := bulk.served_contract(source)) is not None:
            axes, service_dims = served.binding.axes, (served.binding.m,)
            generator = source.reduced(axes)
    n = bulk.pack.info.n
    ours = listed_numbers(generated_dim, "--generated-dim", most=min(axes or n, MAX_M + 1) - 1)
    ours = tuple(dict.fromkeys((*ours, *service_dims)))
    audited = Scheme(str(Strategy.ADVERSARIAL), GENERATED, ours[-1], axes)
    labels = tuple(read_labels(root / f"fairface_label_{part}.csv") for part in ("train", "val"))
    plan = AttributePlan(
        schemes=schemes_of(
            strategies=named,
            dims=listed_numbers(dim, "--dim", most=n - 1),
            generated_dims=ours,
            axes=axes,
        ),
        lifting=default_lifting(len(labels[0])) if lifting is None else lifting,
        attack=attack,
        attacked=attacked,
        axes=axes,
        seed=seed,
    )
    plan.attacker_faces(len(labels[0]))
    parts = plan.sample(*labels)
    photos = [bulk.extract(list(part)) for part in parts]
    faces = [labelled_faces(one, part) for one, part in zip(photos, parts, strict=True)]
    with share_done("attacking templates") as report_share, on_device(on):
        rows, split = run_attribute_audit(plan, *faces, generator=generator, progress=report_share)
    report = document(
        "fairface",
        outcomes=attribute_outcomes(rows, audited=audited),
        rows=[row.to_json() for row in rows],
        limits=limits,
        model=bulk.model,
        settings={
            "root": root.resolve().name,
            "lifting": len(split.lifting),
            "attack": len(split.attack),
            "attacked": len(split.attacked),
            "k": K,
            "decoys": "of the lifting faces" if generator is None else generator.source_id,
            "audited": str(audited),
            "flip": flip,
            "device": device,
            "seed": seed,
        },
        failure_to_acquire={"train": acquired_json(photos[0]), "val": acquired_json(photos[1])},
    )
    return reported(report, out, bulk)
