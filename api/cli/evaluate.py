"""``veilface evaluate``: the paper's face-verification experiment, on any usual benchmark."""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import typer

from api.cli import flags
from api.cli.bulk import BULK, Bulk, listed, listed_numbers, write_document
from api.cli.console import demo_notice, message, progress
from api.cli.errors import UsageError, require_extra
from api.cli.evaluation_inputs import open_all, open_embedder, open_sources
from api.cli.options import Plan, reports
from api.cli.results import Result, Table
from api.settings import Settings
from models.sessions import default_workers
from templates.distances import Metric
from verify.evaluation.cluster import cluster as dask_cluster
from verify.evaluation.embedding import PackEmbedder
from verify.evaluation.labels_file import read_labels
from verify.evaluation.plan import (
    DIMS,
    STRATEGIES,
    TARGETS,
    EvaluationError,
    EvaluationPlan,
    Json,
    Mode,
    default_strategies,
    units_of,
)
from verify.evaluation.tables import markdown, row_cells, write_csv

MODES = {str(mode): mode for mode in (Mode.POINT, Mode.SUBSPACE)}


@reports(*BULK)
def evaluate(
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET...",
            help="An InsightFace `.bin` file, a folder of LFW, CFP or AgeDB-30, or a CSV "
            "`path_a,path_b,same[,fold]` of your own photos.",
        ),
    ],
    *,
    settings: Settings,
    embeddings: Annotated[
        Path | None,
        typer.Option(
            help="With `--pack none`: a `.npz` with `paths` and `descriptors` computed elsewhere."
        ),
    ] = None,
    decoys: Annotated[
        list[Path] | None,
        typer.Option(help="A file of `decoys build`; a pool and a generator may both be given."),
    ] = None,
    strategy: Annotated[
        str | None,
        typer.Option(
            help=f"Of {', '.join(STRATEGIES)}. Unset: all that the decoys allow but the sub- ones."
        ),
    ] = None,
    dim: Annotated[str, typer.Option(help="Subspace dimensions m.")] = ",".join(map(str, DIMS)),
    axes: Annotated[
        int | None,
        typer.Option(min=2, help="Axes for generated decoys. Unset: all, as in the paper."),
    ] = None,
    mode: Annotated[
        str, typer.Option(help="`p2s` lifts one photo of a pair, `s2s` both.")
    ] = ",".join(MODES),
    metric: Annotated[
        str, typer.Option(help="`euclidean` is the paper's, `spherical` what the service uses.")
    ] = ",".join(Metric),
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
    seed: flags.Seed = 0,
    fmr: Annotated[
        str, typer.Option(help="False match rates at which the FNMR is reported.")
    ] = ",".join(f"{target:g}" for target in TARGETS),
    labels: flags.Labels = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("evaluation"),
    aligned: Annotated[
        bool | None,
        typer.Option(
            "--aligned/--no-aligned",
            help="Whether the photos are aligned crops. Unset: where all have the embedder's size.",
        ),
    ] = None,
    flip: flags.Flip = False,
    cache: flags.Cache = None,
    cluster: Annotated[
        str | None,
        typer.Option(help="Scheduler of a Dask cluster, such as `tcp://HOST:PORT`. Unset: here."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Threads here. Unset: one a processor, 8 at most.")
    ] = None,
    _plan: Plan = None,
) -> Result:
    """Evaluate face verification with private templates: the LFW / CFP / AgeDB protocol.

    Writes results.json, results.csv, results.md and figures (PNG and SVG) to --out.
    docs/evaluation.md explains every figure.

    Example: `veilface evaluate lfw.bin --pack buffalo_l --decoys decoys.veil --out lfw-results`
    """
    require_extra("evaluate")
    # Imported here: they load what the core install lacks.
    from verify.evaluation.experiment import evaluate as run_evaluation
    from verify.evaluation.results import document

    bulk = Bulk(settings, flip=flip, cache_file=cache)
    names = None
    if strategy is not None:
        names = listed(strategy, str, "--strategy", expected=f"a list of {', '.join(STRATEGIES)}")
    sets = open_all(datasets, pictures=embeddings is None)
    embedder = open_embedder(bulk, embeddings, aligned=aligned)
    sources = open_sources(decoys or [], bulk, embedder, axes=axes)
    decoy_sources = [facts.source for facts in sources]
    try:
        plan = EvaluationPlan(
            strategies=names or default_strategies(decoy_sources),
            dims=listed_numbers(dim, "--dim"),
            modes=listed(
                mode, MODES.__getitem__, "--mode", expected=f"a list of {', '.join(MODES)}"
            ),
            metrics=listed(metric, Metric, "--metric", expected=f"a list of {', '.join(Metric)}"),
            shared_decoys=shared_decoys,
            repeats=repeats,
            seed=seed,
            targets=tuple(
                sorted(listed(fmr, float, "--fmr", expected="rates such as 1e-2"), reverse=True)
            ),
        )
        units_of(plan, decoy_sources, n=embedder.model["n"])
    except EvaluationError as error:
        raise UsageError(str(error)) from None
    known = None if labels is None else read_labels(labels)
    out.mkdir(parents=True, exist_ok=True)
    local = ThreadPoolExecutor(jobs or min(8, default_workers()))  # of about 0.2 GB each
    with local if cluster is None else dask_cluster(cluster) as executor:
        runs, sets_evaluated = run_evaluation(
            plan,
            embedder,
            sets,
            sources,
            known,
            cache=bulk.cache,
            executor=executor,
            note=lambda sentence: message(f"note: {sentence}"),
            progress=progress,
        )
    options = {
        "flip": flip,
        "axes": axes,
        "cluster": cluster is not None,
        "labels": None if labels is None else _named(labels),
    }
    results = document(plan, embedder.model, sources, runs, sets_evaluated, known, options=options)
    files = [path.name for path in _written(results, out)]
    notice = {}
    if isinstance(embedder, PackEmbedder):
        notice = demo_notice(embedder.pack.info)
    return Result(
        {**notice, "out": out, "files": files, **results},
        [
            *(_summary(results, dataset["name"]) for dataset in results["datasets"]),
            *(f"Not reported: {sentence}." for sentence in results["refused"]),
            f"{out}: {', '.join(files)}.",
        ],
    )


def _named(file: Path) -> Json:
    """Name and SHA-256 of a file that figures depend on."""
    return {"file": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}


def _written(results: Json, out: Path) -> list[Path]:
    # Imported here: drawing loads a library that nothing else needs.
    from verify.evaluation.figures import det_figure, verification_figure
    from verify.evaluation.figures.style import write

    document, report = write_document(results, out, "results", markdown=markdown(results))
    table = out / "results.csv"
    write_csv(results["rows"], table)
    figures = []
    for name, draw in (("figure", verification_figure), ("det", det_figure)):
        # What an earlier run drew of other rows must not stand beside these.
        for suffix in (".png", ".svg"):
            (out / f"{name}{suffix}").unlink(missing_ok=True)
        figure = draw(results)
        figures += [] if figure is None else write(figure, out, name)
    return [document, table, report, *figures]


def _summary(results: Json, dataset: str) -> Table:
    rows = [row for row in results["rows"] if row["dataset"] == dataset]
    counts = f"{rows[0]['n_genuine']} genuine and {rows[0]['n_impostor']} impostor pairs"
    return Table(f"{dataset}: {counts}", *row_cells(rows))
