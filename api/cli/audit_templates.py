"""``veilface audit templates``: every attack on a template that we know, on people with photos."""

from pathlib import Path
from typing import Annotated

import typer

from api.cli.audit_report import (
    TEMPLATE_LIMITS,
    Limits,
    Out,
    Seed,
    limits_of,
    model_json,
    reported,
    served_scheme,
)
from api.cli.console import message, share_done
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import UsageError, require_extra
from api.cli.inputs import listed_dims, load_decoys
from api.cli.options import DEFAULT_DIM, PROCESSOR, Device, chosen_device, quick
from api.cli.results import Plan, Result, reports
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from attacks.audit import AuditPlan, run_audit
from attacks.report import document
from templates.contract.document import Contract
from templates.decoys.fitting import MIN_DESCRIPTORS
from templates.distances import on_device
from templates.space.lifting import Strategy
from verify import labelled_folder
from verify.preparation import acquired_json


@reports(*BULK)
def templates(
    people: Annotated[
        Path,
        typer.Argument(
            metavar="PEOPLE",
            help="Labelled faces, one subfolder for each person; only people with two photos or "
            "more are attacked or own decoys.",
        ),
    ],
    *,
    settings: Settings,
    decoys: Annotated[
        Path | None,
        typer.Option(help="The file of `decoys build`. Unset: `decoys.veil` in `data_dir`."),
    ] = None,
    contract: Annotated[
        Path | None,
        typer.Option(
            help="Audit this contract, with its strategy, dimension, axes, thresholds and cohort. "
            "Unset: each scheme is calibrated on people of PEOPLE who are not attacked."
        ),
    ] = None,
    strategy: Annotated[
        Strategy | None,
        typer.Option(
            help="How templates are lifted. Unset: that of the contract, else adversarial."
        ),
    ] = None,
    dim: Annotated[
        str | None,
        typer.Option(
            help="Dimensions m of templates, such as 16,32. Unset: that of the contract, else "
            f"{DEFAULT_DIM}."
        ),
    ] = None,
    axes: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Axes that embeddings are projected on. Unset: those of the contract, else those "
            "with 83 % of the decoys' variance.",
        ),
    ] = None,
    victims: Annotated[int, typer.Option(min=20, help="People who are attacked.")] = 300,
    owners: Annotated[
        int,
        typer.Option(
            min=MIN_DESCRIPTORS,
            help="People whose faces are the real decoys of the comparison.",
        ),
    ] = 600,
    comparison: Annotated[
        bool,
        typer.Option(
            help="Attack templates with decoys of real people too, which shows that the attacks "
            "work."
        ),
    ] = True,
    seed: Seed = 0,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
    device: Device = PROCESSOR,
    limit: Limits = None,
    out: Out = Path("audit-templates"),
    _quick: Annotated[bool, quick(victims=50, owners=100)] = False,
    _plan: Plan = None,
) -> Result:
    """Attack private templates: inversion, linkage, renewal, impersonation.

    Writes report.json, report.md and figures to --out.
    Without --contract, --strategy, --dim and --axes are those of the contract in `data_dir` where
    it is of these decoys. Exit status 1: an attack exceeds its limit; 3: none does, and too few
    people or faces show it. docs/privacy.md leads to what each attack is.

    Example: `veilface audit templates lfw --pack buffalo_l --decoys decoys.veil --out audit`
    """
    require_extra("audit")
    limits = limits_of(limit, TEMPLATE_LIMITS)
    torch_device = chosen_device(device)
    pack = bulk_pack(settings, flip=flip, why="an audit attacks embeddings of a model pack")
    sealer = file_sealer(open_keyring(settings))
    loaded = None if contract is None else Contract.load(contract, sealer)
    if loaded is not None and any(one is not None for one in (strategy, dim, axes)):
        raise UsageError(
            "a contract says its strategy, dimension and axes: leave out --strategy, --dim, --axes"
        )
    source = load_decoys(decoys or settings.resolved_decoys_file, sealer, pack)
    if loaded is not None:
        own = source.reduced(loaded.binding.axes)
        loaded.binding.require_source(own)
    elif None in (dim, strategy, axes) and (served := served_scheme(settings, sealer, source)):
        dim, strategy = dim or str(served.m), strategy or served.strategy
        axes = axes or served.axes
        path = settings.resolved_contract_file
        message(f"note: auditing {strategy} templates of m = {dim}: what is not set is {path}'s")
    # Of a contract both are its own.
    dim, strategy = dim or str(DEFAULT_DIM), strategy or Strategy.ADVERSARIAL
    plan = AuditPlan(
        strategy=strategy,
        dims=listed_dims(dim, "--dim", n=axes or pack.info.n, example="16,32"),
        axes=axes,
        contract=loaded,
        victims=victims,
        owners=owners,
        comparison=comparison,
        seed=seed,
    )
    labelled = labelled_folder(people)
    faces = extract(pack, labelled.paths, aligned=aligned, settings=settings, cache=cache)
    name_of = dict(zip(labelled.paths, labelled.identities, strict=True))
    with share_done("auditing") as report_share, on_device(torch_device):
        result = run_audit(
            plan,
            faces,
            [name_of[path] for path in faces.paths],
            pack=pack,
            decoys=source,
            progress=report_share,
        )
    report = document(
        "templates",
        outcomes=result.outcomes,
        limits=limits,
        comparisons=result.comparisons,
        model=model_json(pack),
        settings={
            "people": labelled.root.resolve().name,
            **result.settings,
            "flip": flip,
            "device": device,
        },
        schemes=result.schemes,
        failure_to_acquire=acquired_json(faces),
    )
    return reported(report, out, pack)
