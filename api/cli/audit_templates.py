"""``veilface audit templates``: every attack on a template that we know, on people with photos."""

from pathlib import Path
from typing import Annotated

import typer

from api.cli import flags
from api.cli.audit_report import Limits, Out, limits_of, reported
from api.cli.bulk import BULK, Bulk, listed_numbers
from api.cli.console import message, share_done
from api.cli.errors import require_extra
from api.cli.options import PROCESSOR, Plan, reports, torch_device
from api.cli.results import Result
from api.settings import Settings
from attacks.audit import AuditPlan, run_audit
from attacks.report import document
from templates.decoys.fitting import MIN_DESCRIPTORS
from templates.distances import on_device
from templates.space.lifting import Strategy
from verify import labelled_folder
from verify.preparation import acquired_json


@reports(*BULK)
def templates(
    people: Annotated[Path, typer.Argument(help="Labelled faces, one subfolder for each person.")],
    *,
    settings: Settings,
    decoys: flags.Decoys = None,
    strategy: Annotated[
        Strategy | None, typer.Option(help="How templates of a scheme are lifted: adversarial.")
    ] = None,
    dim: Annotated[
        str | None, typer.Option(help="Dimensions of a scheme, such as 16,32. Unset: 64.")
    ] = None,
    axes: Annotated[
        int | None,
        typer.Option(min=2, help="Axes of a scheme. Unset: those with 83 % of the variance."),
    ] = None,
    victims: Annotated[int, typer.Option(min=20, help="People who are attacked.")] = 300,
    owners: Annotated[
        int, typer.Option(min=MIN_DESCRIPTORS, help="People who are decoys of the comparison.")
    ] = 600,
    comparison: Annotated[
        bool, typer.Option(help="Show on decoys of real people that the attacks work.")
    ] = True,
    seed: flags.Seed = 0,
    aligned: flags.Aligned = False,
    flip: flags.Flip = False,
    cache: flags.Cache = None,
    device: flags.Device = PROCESSOR,
    limit: Limits = None,
    out: Out = Path("audit-templates"),
    _plan: Plan = None,
) -> Result:
    """Attack private templates: inversion, linkage, renewal, impersonation.

    Of the contract in `data_dir` where it is of these decoys; or of schemes that --strategy, --dim
    or --axes describe, calibrated on people of PEOPLE who are not attacked. Writes report.json,
    report.md and figures to --out. Exit status 1: an attack exceeds its limit; 3: none does, and
    too few people or faces show it. docs/privacy.md leads to what each attack is.

    Example: `veilface audit templates lfw --pack buffalo_l --decoys decoys.veil --out audit`
    """
    require_extra("audit")
    limits = limits_of(limit)
    on = torch_device(device)
    bulk = Bulk(settings, aligned=aligned, flip=flip, cache_file=cache)
    source = bulk.decoys(decoys)
    contract = None
    if not (strategy or dim or axes) and (contract := bulk.served_contract(source)) is not None:
        message(f"note: auditing the contract {settings.resolved_contract_file}")
    plan = AuditPlan(
        strategy=strategy or Strategy.ADVERSARIAL,
        dims=listed_numbers(dim or "64", "--dim", most=(axes or source.k) - 1),
        axes=axes,
        contract=contract,
        victims=victims,
        owners=owners,
        comparison=comparison,
        seed=seed,
    )
    if contract is None:
        message(f"note: auditing a scheme of no service: {plan.strategy}, m {dim or 64}")
    labelled = labelled_folder(people)
    faces = bulk.extract(labelled.paths)
    name_of = dict(zip(labelled.paths, labelled.identities, strict=True))
    with share_done("auditing") as report_share, on_device(on):
        result = run_audit(
            plan,
            faces,
            [name_of[path] for path in faces.paths],
            pack=bulk.pack,
            decoys=source,
            progress=report_share,
        )
    report = document(
        "templates",
        outcomes=result.outcomes,
        limits=limits,
        comparisons=result.comparisons,
        model=bulk.model,
        settings={
            "people": labelled.root.resolve().name,
            **result.settings,
            "flip": flip,
            "device": device,
        },
        schemes=result.schemes,
        failure_to_acquire=acquired_json(faces),
    )
    return reported(report, out, bulk)
