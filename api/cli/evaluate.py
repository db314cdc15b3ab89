"""``veilface evaluate``: the paper's face-verification experiment, on any usual benchmark."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import demo_notice, emit, message, progress, say, show
from api.cli.descriptors import BULK, Cache, Flip
from api.cli.errors import UsageError, require_extra
from api.cli.evaluation_inputs import (
    Descriptors,
    Faces,
    acquire_faces,
    attributes_of,
    default_jobs,
    open_cache,
    open_descriptors,
    open_sources,
    resemblance,
    without_test_people,
)
from api.cli.evaluation_report import read_audit, summary, write_results
from api.cli.inputs import listed, named_file
from api.cli.options import AsJson, takes_settings
from api.settings import Settings
from templates.decoys import DecoyPool
from templates.distances import Metric
from templates.keys.private_file import make_folder
from templates.space.lifting import Strategy
from verify.evaluation.backends import Backend, BackendError
from verify.evaluation.evaluation import evaluate_set, prepare
from verify.evaluation.group_rows import group_rows
from verify.evaluation.labels_file import Labels, read_labels
from verify.evaluation.plan import (
    DIMS,
    STRATEGIES,
    TARGETS,
    WITHOUT_DECOYS,
    EvaluationError,
    Plan,
    units_of,
)
from verify.evaluation.readers import notes, open_sets
from verify.evaluation.results import SetResult, SourceFacts, document
from verify.evaluation.rows import Json
from verify.evaluation.timing import timings
from verify.evaluation.units import RAW_FLIP, Mode
from verify.evaluation.verification_set import VerificationSet

LIFTED_MODES = (Mode.POINT, Mode.SUBSPACE)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(evaluate)


@takes_settings(*BULK)
def evaluate(
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET...",
            help="What to evaluate on: an InsightFace `.bin` file, a folder of LFW, CFP or "
            "AgeDB-30, or a CSV `path_a,path_b,same[,fold]` of your own photos.",
            show_default=False,
        ),
    ],
    *,
    settings: Settings,
    embeddings: Annotated[
        Path | None,
        typer.Option(
            help="With `--pack none`: embeddings computed elsewhere, a `.npz` file with the "
            "arrays `paths` and `descriptors`.",
            show_default=False,
        ),
    ] = None,
    decoys: Annotated[
        list[Path] | None,
        typer.Option(
            help="A file of `decoys build`; a pool and a generator may both be given. Without "
            "one, only strategies without decoys run.",
            show_default=False,
        ),
    ] = None,
    strategy: Annotated[
        str | None,
        typer.Option(
            help=f"Of {', '.join(STRATEGIES)}. Unset: all that the decoys allow but the sub- ones.",
            show_default=False,
        ),
    ] = None,
    dim: Annotated[str, typer.Option(help="Subspace dimensions m.")] = ",".join(map(str, DIMS)),
    mode: Annotated[
        str, typer.Option(help="`p2s` lifts one photo of a pair, `s2s` both.")
    ] = "p2s,s2s",
    metric: Annotated[
        str, typer.Option(help="`euclidean` is the paper's, `spherical` what the service uses.")
    ] = "euclidean,spherical",
    shared_decoys: Annotated[
        bool,
        typer.Option(
            "--shared-decoys",
            help="Both photos draw decoys from the whole pool, as in the paper. Unset: each from "
            "a half of its own.",
        ),
    ] = False,
    repeats: Annotated[
        int, typer.Option(min=1, help="Repeat all that is random, with seeds from --seed on.")
    ] = 5,
    seed: Annotated[int, typer.Option(min=0, help="The first seed.")] = 0,
    fmr: Annotated[
        str, typer.Option(help="False match rates at which the FNMR is reported.")
    ] = ",".join(f"{target:g}" for target in TARGETS),
    labels: Annotated[
        Path | None,
        typer.Option(
            help="A CSV `path,gender,race,age,...` of photos or people: gives results by group, "
            "and hybrid+ its attributes.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results; a run goes on there.")] = Path(
        "evaluation"
    ),
    aligned: Annotated[
        bool | None,
        typer.Option(
            "--aligned/--no-aligned",
            help="Whether the photos are aligned crops. Unset: they are where all of them have "
            "the size that the embedder takes, and in `.bin` files.",
            show_default=False,
        ),
    ] = None,
    flip: Flip = False,
    cache: Cache = None,
    backend: Annotated[
        str,
        typer.Option(
            help="`local`, or `dask://HOST:PORT` of a Dask scheduler (`dask+tls://` with TLS), "
            "whose workers have veilface."
        ),
    ] = "local",
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Local processes. Unset: one a processor, 8 at most."),
    ] = None,
    audit: Annotated[
        Path | None,
        typer.Option(
            help="A `report.json` of `veilface audit`: adds the figure of privacy against "
            "accuracy.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate face verification with private templates: the LFW / CFP / AgeDB protocol.

    Writes results.json, results.csv, results.md and figures (PNG and SVG) to --out. An
    interrupted run goes on where it stopped. docs/evaluation.md explains every figure.

    Example: `veilface evaluate lfw.bin --pack buffalo_l --decoys decoys.veil --out lfw-results`
    """
    require_extra("evaluate")
    try:
        where = Backend.parse(backend, jobs=jobs or default_jobs())
    except BackendError as error:
        raise UsageError(str(error)) from None
    sets = _open_all(datasets, pictures=embeddings is None)
    report = None if audit is None else read_audit(audit)
    asked = None
    if strategy is not None:
        asked = listed(strategy, str, "--strategy", expected="names of strategies")
    wants_flip = _wants_flip(asked, embeddings, flip=flip)
    descriptors = open_descriptors(settings, embeddings, flip=flip, both=wants_flip)
    sources = open_sources(decoys or [], settings, descriptors)
    plan = _plan(
        asked=asked,
        has_flip=wants_flip,
        sources=sources,
        dims=listed(dim, int, "--dim", expected="whole numbers such as 2,4"),
        modes=listed(mode, _mode, "--mode", expected=f"a list of {', '.join(LIFTED_MODES)}"),
        metrics=listed(metric, Metric, "--metric", expected=f"a list of {', '.join(Metric)}"),
        shared=shared_decoys,
        repeats=repeats,
        seed=seed,
        targets=listed(fmr, float, "--fmr", expected="rates such as 1e-2,1e-3"),
    )
    try:
        units_of(plan, [each.source for each in sources], n=descriptors.n)
    except EvaluationError as error:
        raise UsageError(str(error)) from None
    known = None if labels is None else read_labels(labels)
    if cache is not None and where.scheduler is not None:
        message("note: --cache is not used with a cluster; its workers keep no embeddings")
    kept = open_cache(cache, settings)
    make_folder(out)
    faces = [
        acquire_faces(pairs, descriptors, settings, aligned=aligned, cache=kept, backend=where)
        for pairs in sets
    ]
    results = _evaluate(
        plan,
        descriptors,
        faces,
        sources,
        known,
        out=out,
        backend=where,
        options={
            "flip": flip,
            "backend": "local" if where.scheduler is None else "dask",
            "labels": named_file(labels),
            "audit": named_file(audit),
        },
    )
    written = write_results(results, out, audit=report)
    info = None if descriptors.pack is None else descriptors.pack.info
    notice = {} if info is None else demo_notice(info.embedder_sha256, n=info.n)
    if as_json:
        emit({**notice, "out": str(out), "files": [path.name for path in written], **results})
        return
    for each in results["datasets"]:
        show(summary(results, each["name"]))
    for sentence in results["refused"]:
        say(f"Not reported: {sentence}.")
    say(f"{out}: {', '.join(path.name for path in written)}.")


def _mode(text: str) -> Mode:
    chosen = Mode(text)
    if chosen not in LIFTED_MODES:
        raise ValueError(text)
    return chosen


def _open_all(datasets: Sequence[Path], *, pictures: bool) -> list[VerificationSet]:
    sets = [pairs for path in datasets for pairs in open_sets(path, pictures=pictures)]
    names = [pairs.name for pairs in sets]
    if len(set(names)) < len(names):
        raise UsageError(
            f"two sets have one name ({', '.join(sorted(names))}), and rows are told apart by it: "
            "evaluate them one at a time, or rename a file"
        )
    for pairs in sets:
        for note in notes(pairs):
            message(f"note: {note}")
    return sets


def _wants_flip(asked: tuple[str, ...] | None, embeddings: Path | None, *, flip: bool) -> bool:
    """Whether raw descriptors with the mirror image are compared beside the others."""
    if asked is None:
        return embeddings is None and not flip
    if RAW_FLIP in asked and (embeddings is not None or flip):
        raise UsageError(
            f"{RAW_FLIP} is raw embeddings with the mirror image added, beside raw ones without: "
            "it needs a pack, and no --flip"
        )
    return RAW_FLIP in asked


def _plan(
    *,
    asked: tuple[str, ...] | None,
    has_flip: bool,
    sources: Sequence[SourceFacts],
    dims: tuple[int, ...],
    modes: tuple[Mode, ...],
    metrics: tuple[Metric, ...],
    shared: bool,
    repeats: int,
    seed: int,
    targets: tuple[float, ...],
) -> Plan:
    strategies = asked
    if strategies is None:
        pools = [each.source for each in sources if isinstance(each.source, DecoyPool)]
        able = set(WITHOUT_DECOYS) - (set() if has_flip else {RAW_FLIP})
        able |= {Strategy.ADVERSARIAL, Strategy.HYBRID} if sources else set()
        able |= {Strategy.HYBRID_PLUS} if any(pool.labelled for pool in pools) else set()
        strategies = tuple(name for name in STRATEGIES if name in able)
    try:
        return Plan(
            strategies=strategies,
            dims=dims,
            modes=modes,
            metrics=metrics,
            shared_decoys=shared,
            repeats=repeats,
            seed=seed,
            targets=tuple(sorted(targets, reverse=True)),
        )
    except EvaluationError as error:
        raise UsageError(str(error)) from None


def _evaluate(
    plan: Plan,
    descriptors: Descriptors,
    faces: Sequence[Faces],
    sources: Sequence[SourceFacts],
    labels: Labels | None,
    *,
    out: Path,
    backend: Backend,
    options: Json,
) -> Json:
    predicted: dict[str, int] = {}
    sets: list[SetResult] = []
    groups: list[Json] = []
    summaries: list[Json] = []
    measured: list[Json] = []
    alike: dict[str, Json] = {}
    for each in faces:
        own = without_test_people(sources, each)
        decoys = [source.source for source in own]
        attributes = None
        if Strategy.HYBRID_PLUS in plan.strategies:
            attributes, predicted[each.pairs.name] = attributes_of(each, labels, own)
        material, facts, kept = prepare(
            each.pairs,
            each.acquired,
            attributes=attributes,
            sources=decoys,
        )
        units = units_of(plan, decoys, n=material.n)
        with progress(f"evaluating {each.pairs.name}", len(units)) as advance:
            evaluated = evaluate_set(
                material,
                facts,
                kept,
                plan=plan,
                out=out,
                backend=backend,
                progress=advance,
            )
        sets.append(
            SetResult(
                each.pairs,
                evaluated,
                own,
                each.acquired.failures,
                each.aligned,
                each.pictures_sha256,
                tuple(notes(each.pairs)),
            )
        )
        if any(isinstance(source, DecoyPool) for source in decoys):
            alike[each.pairs.name] = resemblance(material)
        if labels is not None:
            entries, whole = group_rows(each.pairs, evaluated, labels, seed=plan.seed)
            groups += entries
            summaries += whole
        if not measured:
            measured = timings(material, list(evaluated.source_of.items()))
    return document(
        plan,
        descriptors.model,
        sources,
        sets,
        options={**options, "predicted_attributes": predicted, "resemblance": alike},
        timings=measured,
        groups=groups,
        group_summaries=summaries,
    )
