"""``veilface audit fairface``: what templates tell about gender, race and age."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from api.cli.audit_report import Out, Seed, conclude, default_of, limit_option
from api.cli.console import demo_notice, message, share_done
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import CommandError, UsageError, require_extra
from api.cli.evaluation_inputs import listed, named_file
from api.cli.fairface import Label, read_labels
from api.cli.files import read_bounded
from api.cli.options import AsJson, takes_settings
from api.process.preparation import DEFAULT_DIM, acquired_json, recorded_of
from api.settings import Settings
from attacks.attribute_outcomes import attribute_outcomes
from attacks.attributes.attackers import TRAINED
from attacks.attributes.cost import measure_cost
from attacks.attributes.experiment import run_scheme, work_of
from attacks.attributes.faces import LabelledFaces, near_duplicates, split
from attacks.attributes.plan import AttributePlan, prepare, schemes_of
from attacks.attributes.rows import AttributeRow
from attacks.frontier import frontier, verification_accuracy
from attacks.outcomes import GENERATED, Scheme
from attacks.report import document
from models.extraction import Extraction
from models.pack import ModelPack
from templates.space.lifting import Strategy
from verify.fairface_labels import AGES, GENDERS, RACES

CLASSES = {"gender": GENDERS, "race": RACES, "age": AGES}
PAPER_LIFTING = 10_000
LEAST_LIFTING = 100
"""Least that a decoy generator is fitted to."""
LIFTING_SHARE = 0.3
"""Of the training faces, where they are too few for the paper's 10,000."""
STRATEGIES = (
    "raw",
    Strategy.RANDOM,
    Strategy.ADVERSARIAL,
    Strategy.HYBRID,
    Strategy.HYBRID_PLUS,
)
DIMS = (2, 4, 8, 16)
GENERATED_DIMS = (2, 4, 8, 16, 32, 64)
KNN = "knn"
ATTACKERS = (KNN, *TRAINED)
_MAX_RESULTS_BYTES = 64 * 2**20


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(fairface)


@takes_settings(*BULK)
def fairface(
    root: Annotated[
        Path,
        typer.Argument(
            metavar="ROOT",
            help="FairFace: a folder with `fairface_label_train.csv`, `fairface_label_val.csv` "
            "and the photos that they name.",
            show_default=False,
        ),
    ],
    *,
    settings: Settings,
    lifting: Annotated[
        int | None,
        typer.Option(
            min=LEAST_LIFTING,
            help="Training faces that are the lifting database. Unset: the paper's 10,000, or "
            "three tenths of a smaller training set.",
            show_default=False,
        ),
    ] = None,
    attack: Annotated[
        int | None,
        typer.Option(
            min=100,
            help="Most training faces that the attacker has. Unset: all others.",
            show_default=False,
        ),
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
    dim: Annotated[str, typer.Option(help="Their dimensions m.")] = ",".join(map(str, DIMS)),
    generated_dim: Annotated[
        str,
        typer.Option(
            help="Dimensions of adversarial lifting with generated decoys, as the service does "
            "by default. --service-dim is among them."
        ),
    ] = ",".join(map(str, GENERATED_DIMS)),
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
            show_default=False,
        ),
    ] = None,
    evaluation: Annotated[
        Path | None,
        typer.Option(
            help="A `results.json` of `veilface evaluate`: adds accuracy against privacy, and the "
            "operating point that it recommends.",
            show_default=False,
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
    max_attribute_leakage: Annotated[float, limit_option("attribute-leakage")] = default_of(
        "attribute-leakage"
    ),
    seed: Seed = 0,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
    out: Out = Path("audit-fairface"),
    as_json: AsJson = False,
) -> None:
    """Infer gender, race and age from templates: the paper's experiment, and stronger attackers.

    Writes report.json, report.md and figures to --out; the paper's figure is among them. Exit
    status 1: the strongest attacker exceeds the limit. docs/privacy.md explains every figure.

    Example: `veilface audit fairface fairface --pack buffalo_l --out audit`
    """
    require_extra("audit")
    pack = bulk_pack(settings, flip=flip, why="an audit attacks embeddings of a model pack")
    wanted = listed(attributes, _attribute, "--attributes", expected=f"of {', '.join(CLASSES)}")
    strategies = listed(strategy, _strategy, "--strategy", expected=f"of {', '.join(STRATEGIES)}")
    if Strategy.HYBRID_PLUS in strategies and not {"gender", "race"} <= set(wanted):
        raise UsageError(
            "hybrid+ chooses decoys by gender and race: add both to --attributes, or leave hybrid+ "
            "out of --strategy"
        )
    schemes = _schemes(
        strategies,
        listed(dim, int, "--dim", expected="whole numbers such as 2,4"),
        listed(generated_dim, int, "--generated-dim", expected="whole numbers such as 16,32"),
        n=pack.info.n,
    )
    plan = AttributePlan(
        k=neighbours,
        attackers=tuple(name for name in _attackers(attackers) if name != KNN),
    )
    results = None if evaluation is None else _read_results(evaluation)
    audited = Scheme(str(Strategy.ADVERSARIAL), GENERATED, service_dim)
    if audited not in schemes:
        raise UsageError(
            f"the verdict is on dimension {service_dim} with generated decoys: add it to "
            "--generated-dim, or name another with --service-dim"
        )
    if results is not None:
        verification_accuracy(results, schemes)
    labels, attacked_labels = _labels(root, "train"), _labels(root, "val")
    if lifting is None:
        lifting = min(PAPER_LIFTING, max(LEAST_LIFTING, int(LIFTING_SHARE * len(labels))))
    # Only what takes part is embedded: a face costs a hundred times what an attack on it does.
    labels = _some(labels, None if attack is None else lifting + attack, seed)
    attacked_labels = _some(attacked_labels, attacked, seed)
    train, train_photos = _faces(labels, pack, wanted, aligned, settings, cache)
    validation, photos = _faces(attacked_labels, pack, wanted, aligned, settings, cache)
    duplicates = 0
    if drop_duplicates is not None:
        gone = near_duplicates(validation.descriptors, train.descriptors, cosine=drop_duplicates)
        validation = validation.take(np.setdiff1d(np.arange(len(validation)), gone))
        duplicates = len(gone)
        message(f"note: {duplicates} faces resemble a training face and are not attacked")
    if attack is not None:
        # Which photos give no descriptor is not known beforehand.
        attack = min(attack, max(1, len(train) - lifting))
    parts = split(
        train, validation, lifting=lifting, attack=attack, attacked_most=attacked, seed=seed
    )
    bench = prepare(parts, plan=plan, seed=seed)
    rows: list[AttributeRow] = []
    with share_done("attacking templates") as report_share:
        total, done = sum(work_of(bench, scheme) for scheme in schemes), 0

        def advance(work: int) -> None:
            nonlocal done
            done += work
            report_share(done / total)

        for scheme in schemes:
            rows += run_scheme(bench, scheme, progress=advance)
    report = document(
        "fairface",
        outcomes=attribute_outcomes(rows, audited=audited),
        rows=[row.to_json() for row in rows],
        limits={"attribute-leakage": max_attribute_leakage},
        model={**recorded_of(pack), "embedder_sha256": pack.info.embedder_sha256},
        settings={
            "root": root.resolve().name,
            "lifting": len(parts.lifting),
            "attack": len(parts.attack),
            "attacked": len(parts.attacked),
            "duplicates_dropped": duplicates,
            "k": neighbours,
            "decoys": "of the lifting faces",
            "audited": str(audited),
            "evaluation": named_file(evaluation),
            "flip": flip,
            "seed": seed,
        },
        cost=[
            {**scheme.to_json(), **measure_cost(n=pack.info.n, m=scheme.dim).to_json()}
            for scheme in _costly(schemes)
        ],
        failure_to_acquire={
            "train": acquired_json(train_photos),
            "val": acquired_json(photos),
        },
    )
    if results is not None:
        report["frontier"] = frontier(results, report["rows"], most_lost=max_accuracy_loss)
    conclude(
        report,
        out,
        as_json=as_json,
        notice=demo_notice(pack.info.embedder_sha256, n=pack.info.n),
        evaluation=results,
    )


def _costly(schemes: Sequence[Scheme]) -> list[Scheme]:
    """One scheme of each dimension: the search takes the same time whatever the decoys."""
    return list({scheme.dim: scheme for scheme in schemes if scheme.dim}.values())


def _attribute(text: str) -> str:
    if text not in CLASSES:
        raise ValueError(text)
    return text


def _strategy(text: str) -> str:
    if text not in STRATEGIES:
        raise ValueError(text)
    return text


def _attackers(text: str) -> tuple[str, ...]:
    return listed(text, _attacker, "--attackers", expected=f"of {', '.join(ATTACKERS)}")


def _attacker(text: str) -> str:
    if text not in ATTACKERS:
        raise ValueError(text)
    return text


def _schemes(
    strategies: Sequence[str], dims: Sequence[int], generated: Sequence[int], *, n: int
) -> list[Scheme]:
    wrong = [m for m in (*dims, *generated) if not 1 <= m < n]
    if wrong:
        raise UsageError(f"dimensions go from 1 to {n - 1} with this pack, not {wrong[0]}")
    return [
        scheme
        for scheme in dict.fromkeys(schemes_of(dims=dims, generated_dims=generated))
        if scheme.decoys == GENERATED or scheme.strategy in strategies
    ]


def _labels(root: Path, part: str) -> dict[Path, Label]:
    file = root / f"fairface_label_{part}.csv"
    if not file.is_file():
        raise CommandError(
            f"{root} has no {file.name}; give the folder of FairFace, with its two label files"
        )
    return read_labels(file)


def _some(labels: dict[Path, Label], most: int | None, seed: int) -> dict[Path, Label]:
    """Choose at most so many photos at random, before any is embedded; all where None."""
    if most is None or most >= len(labels):
        return labels
    photos = list(labels)
    chosen = np.random.default_rng([seed, 3]).permutation(len(photos))[:most]
    return {photos[index]: labels[photos[index]] for index in sorted(chosen.tolist())}


def _faces(
    labels: Mapping[Path, Label],
    pack: ModelPack,
    attributes: Sequence[str],
    aligned: bool,
    settings: Settings,
    cache: Path | None,
) -> tuple[LabelledFaces, Extraction]:
    extraction = extract(pack, list(labels), aligned=aligned, settings=settings, cache=cache)
    found: list[Label] = [labels[path] for path in extraction.paths]
    faces = LabelledFaces.of_names(
        extraction.descriptors,
        {name: [str(getattr(label, name)) for label in found] for name in attributes},
        {name: CLASSES[name] for name in attributes},
    )
    return faces, extraction


def _read_results(file: Path) -> Any:
    try:
        results = json.loads(read_bounded(file, _MAX_RESULTS_BYTES))
    except (ValueError, RecursionError):
        raise CommandError(f"{file.name} is no JSON file") from None
    if not isinstance(results, dict) or results.get("format") != "veilface evaluation":
        raise CommandError(f"{file.name} is no results.json of `veilface evaluate`")
    return results
