"""``veilface evaluate``: the paper's face-verification experiment, on any usual benchmark."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import demo_notice, message, progress
from api.cli.descriptors import BULK, Cache, Flip, open_cache
from api.cli.errors import UsageError, require_extra
from api.cli.evaluation_inputs import (
    default_jobs,
    open_all,
    open_embedder,
    open_sources,
)
from api.cli.evaluation_report import write_results
from api.cli.inputs import listed, named_file
from api.cli.options import quick
from api.cli.results import Plan, Result, Table, reports
from api.settings import Settings
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
from verify.evaluation.tables import markdown, row_cells

LIFTED_MODES = (Mode.POINT, Mode.SUBSPACE)


@reports(*BULK)
def evaluate(
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET...",
            help="What to evaluate on: an InsightFace `.bin` file, a folder of LFW, CFP or "
            "AgeDB-30, or a CSV `path_a,path_b,same[,fold]` of your own photos.",
        ),
    ],
    *,
    settings: Settings,
    embeddings: Annotated[
        Path | None,
        typer.Option(
            help="With `--pack none`: embeddings computed elsewhere, a `.npz` with `paths` and "
            "`descriptors`."
        ),
    ] = None,
    decoys: Annotated[
        list[Path] | None,
        typer.Option(
            help="A file of `decoys build`; a pool and a generator may both be given. Without "
            "one, only strategies without decoys run."
        ),
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
        typer.Option(
            min=2,
            help="Axes that embeddings are projected on for generated decoys. Unset: all, as in "
            "the paper.",
            show_default=False,
        ),
    ] = None,
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
            "and hybrid+ its attributes."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("evaluation"),
    aligned: Annotated[
        bool | None,
        typer.Option(
            "--aligned/--no-aligned",
            help="Whether the photos are aligned crops. Unset: they are where all of them have "
            "the size that the embedder takes, and in `.bin` files.",
        ),
    ] = None,
    flip: Flip = False,
    cache: Cache = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Scheduler of a Dask cluster to compare on, such as `tcp://HOST:PORT`. Unset: "
            "here.",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Threads here. Unset: one a processor, 8 at most."),
    ] = None,
    _quick: Annotated[bool, quick(dim="4,16", metric="spherical", repeats=1)] = False,
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
    from verify.evaluation.figures import det_figure, verification_figure
    from verify.evaluation.results import document

    sets = open_all(datasets, pictures=embeddings is None)
    names = None
    if strategy is not None:
        names = listed(strategy, str, "--strategy", expected="names of strategies")
    embedder = open_embedder(settings, embeddings, flip=flip, aligned=aligned)
    sources = open_sources(decoys or [], settings, embedder, axes=axes)
    decoy_sources = [facts.source for facts in sources]
    try:
        plan = EvaluationPlan(
            strategies=names or default_strategies(decoy_sources),
            dims=listed(dim, int, "--dim", expected="whole numbers such as 2,4"),
            modes=listed(mode, _mode, "--mode", expected=f"a list of {', '.join(LIFTED_MODES)}"),
            metrics=listed(metric, Metric, "--metric", expected=f"a list of {', '.join(Metric)}"),
            shared_decoys=shared_decoys,
            repeats=repeats,
            seed=seed,
            targets=tuple(sorted(_rates(fmr), reverse=True)),
        )
        units_of(plan, decoy_sources, n=embedder.model["n"])
    except EvaluationError as error:
        raise UsageError(str(error)) from None
    known = None if labels is None else read_labels(labels)
    kept = open_cache(cache, settings)
    out.mkdir(parents=True, exist_ok=True)
    local = ThreadPoolExecutor(jobs or default_jobs())
    with local if cluster is None else dask_cluster(cluster) as executor:
        runs, sets_evaluated = run_evaluation(
            plan,
            embedder,
            sets,
            sources,
            known,
            cache=kept,
            executor=executor,
            note=lambda sentence: message(f"note: {sentence}"),
            progress=progress,
        )
    results = document(
        plan,
        embedder.model,
        sources,
        runs,
        sets_evaluated,
        known,
        options={
            "flip": flip,
            "axes": axes,
            "cluster": cluster is not None,
            "labels": named_file(labels),
        },
    )
    drawings = {"figure": verification_figure, "det": det_figure}
    written = write_results(results, markdown(results), drawings, out)
    notice = {}
    if isinstance(embedder, PackEmbedder):
        info = embedder.pack.info
        notice = demo_notice(info.embedder_sha256, n=info.n)
    return Result(
        {**notice, "out": out, "files": [path.name for path in written], **results},
        [
            *(_summary(results, dataset["name"]) for dataset in results["datasets"]),
            *(f"Not reported: {sentence}." for sentence in results["refused"]),
            f"{out}: {', '.join(path.name for path in written)}.",
        ],
    )


def _summary(results: Json, dataset: str) -> Table:
    rows = [row for row in results["rows"] if row["dataset"] == dataset]
    counts = f"{rows[0]['n_genuine']} genuine and {rows[0]['n_impostor']} impostor pairs"
    return Table(f"{dataset}: {counts}", *row_cells(rows))


def _rates(text: str) -> tuple[float, ...]:
    return listed(text, float, "--fmr", expected="rates such as 1e-2,1e-3")


def _mode(text: str) -> Mode:
    chosen = Mode(text)
    if chosen not in LIFTED_MODES:
        raise ValueError(text)
    return chosen
