"""``veilface audit fairface``: what templates tell about gender, race and age."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.audit_report import Out, Seed, conclude, model_json, share_once_begun, takes_limits
from api.cli.console import message
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import CommandError, UsageError, require_extra
from api.cli.inputs import fairface_labels, listed_dims, listed_names, named_file, read_json
from api.cli.options import PROCESSOR, AsJson, Device, chosen_device, quick, takes_settings
from api.process.preparation import DEFAULT_DIM, acquired_json
from api.settings import Settings
from attacks.attributes.attackers import TRAINED
from attacks.attributes.audit import (
    AttributeAuditPlan,
    attribute_outcomes,
    default_lifting,
    labelled_faces,
    run_attribute_audit,
)
from attacks.attributes.plan import OUR_DIMS, PAPER_DIMS, AttributePlan, schemes_of
from attacks.frontier import frontier, verification_accuracy
from attacks.outcomes import GENERATED, Scheme
from attacks.population import LEAST_FITTED
from attacks.report import document
from templates.distances import on_device
from templates.space.lifting import Strategy
from verify.fairface_labels import CLASSES

STRATEGIES = (
    "raw",
    Strategy.RANDOM,
    Strategy.ADVERSARIAL,
    Strategy.HYBRID,
    Strategy.HYBRID_PLUS,
)
KNN = "knn"
ATTACKERS = (KNN, *TRAINED)


@takes_settings(*BULK)
@takes_limits("attribute-leakage")
def fairface(
    root: Annotated[
        Path,
        typer.Argument(
            metavar="ROOT",
            help="FairFace: a folder with `fairface_label_train.csv`, `fairface_label_val.csv` "
            "and the photos that they name.",
        ),
    ],
    *,
    settings: Settings,
    limits: Mapping[str, float],
    lifting: Annotated[
        int | None,
        typer.Option(
            min=LEAST_FITTED,
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
    attributes: Annotated[str, typer.Option(help="What is inferred.")] = ",".join(CLASSES),
    strategy: Annotated[
        str, typer.Option(help="Strategies with the decoys of the lifting database.")
    ] = ",".join(STRATEGIES),
    dim: Annotated[str, typer.Option(help="Their dimensions m.")] = ",".join(map(str, PAPER_DIMS)),
    generated_dim: Annotated[
        str,
        typer.Option(
            help="Dimensions of adversarial lifting with generated decoys, as the service does "
            "by default. --service-dim is among them."
        ),
    ] = ",".join(map(str, OUR_DIMS)),
    attackers: Annotated[str, typer.Option(help="Who attacks; `knn` is the paper's.")] = ",".join(
        (KNN, *AttributePlan().attackers)
    ),
    neighbours: Annotated[int, typer.Option("--k", min=1, help="Neighbours of `knn`.")] = 10,
    drop_duplicates: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Do not attack faces that resemble a training face to this cosine, such as 0.8: "
            "FairFace has near-duplicates.",
        ),
    ] = None,
    evaluation: Annotated[
        Path | None,
        typer.Option(
            help="A `results.json` of `veilface evaluate`: adds accuracy against privacy, and the "
            "operating point that it recommends."
        ),
    ] = None,
    max_accuracy_loss: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            help="With --evaluation: most of the raw accuracy that a recommended scheme loses.",
        ),
    ] = 0.01,
    service_dim: Annotated[
        int,
        typer.Option(
            min=1,
            help="The dimension that the verdict is on, of adversarial lifting with generated "
            "decoys; the other schemes are compared with it.",
        ),
    ] = DEFAULT_DIM,
    seed: Seed = 0,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
    device: Device = PROCESSOR,
    out: Out = Path("audit-fairface"),
    _quick: Annotated[
        bool, quick(lifting=300, attack=700, attacked=300, dim="4,16", generated_dim="16,64")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Infer gender, race and age from templates: the paper's experiment, and stronger attackers.

    Writes report.json, report.md, figures, the paper's among them, and report.html, which has all
    to read in one file, to --out. Exit status 1: the strongest attacker exceeds the limit.
    docs/privacy-templates.md explains every figure.

    Example: `veilface audit fairface fairface --pack buffalo_l --out audit`
    """
    require_extra("audit")
    torch_device = chosen_device(device)
    pack = bulk_pack(settings, flip=flip, why="an audit attacks embeddings of a model pack")
    wanted = listed_names(attributes, tuple(CLASSES), "--attributes")
    strategies = listed_names(strategy, STRATEGIES, "--strategy")
    if Strategy.HYBRID_PLUS in strategies and not {"gender", "race"} <= set(wanted):
        raise UsageError(
            "hybrid+ chooses decoys by gender and race: add both to --attributes, or leave hybrid+ "
            "out of --strategy"
        )
    grid = schemes_of(
        dims=listed_dims(dim, "--dim", n=pack.info.n, example="2,4"),
        generated_dims=listed_dims(
            generated_dim, "--generated-dim", n=pack.info.n, example="16,32"
        ),
    )
    schemes = [
        scheme for scheme in grid if scheme.decoys == GENERATED or scheme.strategy in strategies
    ]
    trained = [name for name in listed_names(attackers, ATTACKERS, "--attackers") if name != KNN]
    results = None if evaluation is None else _read_results(evaluation)
    audited = Scheme(str(Strategy.ADVERSARIAL), GENERATED, service_dim)
    if audited not in schemes:
        raise UsageError(
            f"the verdict is on dimension {service_dim} with generated decoys: add it to "
            "--generated-dim, or name another with --service-dim"
        )
    if results is not None:
        verification_accuracy(results, schemes)
    labels = fairface_labels(root, "train"), fairface_labels(root, "val")
    plan = AttributeAuditPlan(
        schemes=tuple(schemes),
        attributes=wanted,
        attackers=AttributePlan(k=neighbours, attackers=tuple(trained)),
        lifting=default_lifting(len(labels[0])) if lifting is None else lifting,
        attack=attack,
        attacked=attacked,
        drop_duplicates=drop_duplicates,
        seed=seed,
    )
    plan.require_faces(labels[0])
    photos, faces = [], []
    for part in plan.sample(*labels):
        extraction = extract(pack, list(part), aligned=aligned, settings=settings, cache=cache)
        photos.append(extraction)
        faces.append(labelled_faces(extraction, part, wanted))
    with share_once_begun("attacking templates") as report_share, on_device(torch_device):
        audit = run_attribute_audit(plan, *faces, progress=report_share)
    if drop_duplicates is not None:
        message(f"note: {audit.duplicates} faces resemble a training face and are not attacked")
    report = document(
        "fairface",
        outcomes=attribute_outcomes(audit.rows, audited=audited),
        rows=[row.to_json() for row in audit.rows],
        limits=limits,
        model=model_json(pack),
        settings={
            "root": root.resolve().name,
            **audit.settings(),
            "k": neighbours,
            "decoys": "of the lifting faces",
            "audited": str(audited),
            "evaluation": named_file(evaluation),
            "flip": flip,
            "device": device,
            "seed": seed,
        },
        cost=audit.cost,
        failure_to_acquire={
            "train": acquired_json(photos[0]),
            "val": acquired_json(photos[1]),
        },
    )
    if results is not None:
        report["frontier"] = frontier(results, report["rows"], most_lost=max_accuracy_loss)
    conclude(report, out, pack, as_json=as_json, evaluation=results)


def _read_results(file: Path) -> Any:
    results = read_json(file)
    if not isinstance(results, dict) or results.get("format") != "veilface evaluation":
        raise CommandError(f"{file.name} is not a results.json of `veilface evaluate`")
    return results
