"""``veilface bench``: how fast this machine is, as ratios to what it cannot do without."""

import os
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from rich.table import Table

from api.cli import model_bench
from api.cli.console import demo_notice, emit, message, progress, say, show, table
from api.cli.distance_bench import (
    MODES,
    Question,
    Row,
    machine,
    measure,
    memory_needed,
)
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_photo
from api.cli.inputs import listed
from api.cli.options import AsJson, takes_settings
from api.settings import MAX_ONNX_THREADS, Settings, processors
from templates.distances import DEFAULT_STEPS, Metric, require_device
from templates.errors import TemplateError

C = TypeVar("C", bound=StrEnum)

_SMALLER = "take a smaller --count, or fewer of --dim and --n"

app = typer.Typer(no_args_is_help=True)


@app.callback()
def bench() -> None:
    """Time this machine, against the work that nothing can avoid."""


@app.command()
def distances(
    *,
    count: Annotated[
        int, typer.Option(min=1, help="Probes, and templates: COUNT × COUNT distances.")
    ] = 1000,
    n: Annotated[str, typer.Option("--n", help="Numbers in an embedding.")] = "128,512",
    dim: Annotated[str, typer.Option(help="Dimensions m of the subspaces.")] = "2,4,8,16",
    mode: Annotated[
        str, typer.Option(help="`p2s` compares points with templates, `s2s` lifted probes.")
    ] = "p2s,s2s",
    metric: Annotated[
        str, typer.Option(help="`euclidean` is the paper's, `spherical` the service's.")
    ] = "euclidean,spherical",
    repeats: Annotated[
        int, typer.Option(min=1, help="Timed repeats; medians of them are shown.")
    ] = 5,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Threads of the distances and of the products. Unset: those of the matrix "
            "library. Not with --device.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            help="Device of torch, such as `cuda` (extra `torch`). Unset: the processor, without "
            "torch."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the embeddings.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Time all distances between probes and templates, beside the bare matrix product.

    Needs the extra `evaluate`. It draws embeddings of nobody, spread like faces, and lifts them.
    Every time is shown as a multiple of the products that a distance starts from, made as one
    matrix (`× product`), timed in turn in the same run; `authors` is the paper's Euclidean formula
    as its authors compute it, in multiples of our time. The default options take some minutes; the
    first run on a machine compiles the loops, which takes half a minute.

    Example: `veilface bench distances --n 512 --dim 16 --metric spherical`
    """
    question = Question(
        count=count,
        dimensions=_numbers(n, "--n", at_least=2),
        dims=_numbers(dim, "--dim", at_least=1),
        modes=_chosen(mode, MODES, "--mode"),
        metrics=_chosen(metric, tuple(Metric), "--metric"),
        repeats=repeats,
        threads=threads,
        device=device,
        seed=seed,
    )
    _check(question)
    facts = machine(question)
    try:
        with progress("measuring", question.cells) as advance:
            rows = measure(question, progress=advance)
    except MemoryError:
        raise CommandError(f"not enough memory for the products: {_SMALLER}") from None
    if as_json:
        emit(
            {
                "machine": facts,
                "count": count,
                "repeats": repeats,
                "steps": DEFAULT_STEPS,
                "dtype": "float32",
                "seed": seed,
                "rows": [row.to_json() for row in rows],
            }
        )
        return
    show(_listing(question, rows))
    say(
        f"Of {repeats} repeats: median times, and medians of their ratios (smallest to largest in "
        "brackets)."
    )
    place = f"{facts['processors']} processors" if device is None else device
    say(f"Measured on {place}. docs/contributing.md#distances says how to read it.")


@app.command()
@takes_settings("pack", "providers")
def models(
    *,
    settings: Settings,
    photo: Annotated[
        list[Path] | None,
        typer.Option(
            help="A photo with a face; repeat for more. Unset: some are drawn.", show_default=False
        ),
    ] = None,
    threads: Annotated[
        str | None,
        typer.Option(
            help="Values of `onnx_threads` to try beside its default. Unset: 1, 2, 4 and 8, as far "
            "as there are processors.",
            show_default=False,
        ),
    ] = None,
    repeats: Annotated[
        int, typer.Option(min=1, help="Timed repeats; medians of them are shown.")
    ] = 9,
    as_json: AsJson = False,
) -> None:
    """Time a pack, and say which `onnx_threads` and `compute_slots` suit this machine.

    Needs: a pack. Run it where the service will run, and while little else runs there. Each graph
    is timed with the optimisations of ONNX Runtime, and whole photos with one caller, with as many
    as there are processors, and with twice as many. Takes some minutes.

    Example: `veilface bench models --pack ~/.insightface/models/buffalo_l`
    """
    if settings.pack is None:
        raise UsageError("a pack is what is timed; name it with --pack")
    here = processors()
    if threads is None:
        threads = ",".join(str(count) for count in (1, 2, 4, 8) if count <= here)
    bench = model_bench.ModelBench(
        path=settings.pack,
        providers=settings.providers,
        threads=_numbers(threads, "--threads", at_least=1, at_most=MAX_ONNX_THREADS),
        repeats=repeats,
        photos={str(path): read_photo(path, settings.max_image_bytes) for path in photo or ()},
    )
    with progress("measuring", bench.rounds) as advance:
        photos, graphs = bench.time_photos(advance), bench.time_graphs(advance)
    used = max(row.processors_used for row in photos)
    if used < 0.75 * here:
        message(
            f"note: the photos used {used:.1f} of {here} processors at most; if other programs had "
            "the rest, measure again without them"
        )
    info, advised = bench.pack.info, model_bench.advice(photos)
    notice = demo_notice(info.embedder_sha256, n=info.n)
    if as_json:
        emit(
            {
                "pack": info.name,
                "processors": here,
                "providers": settings.providers,
                "repeats": repeats,
                "graphs": [row._asdict() for row in graphs],
                "photos": [row._asdict() for row in photos],
                "advice": advised,
                **notice,
            }
        )
        return
    show(
        _medians(f"One inference of {info.name}", graphs, model_bench.GraphRow._fields),
        _medians("Whole photos", photos, model_bench.PhotoRow._fields[:-2]),
    )
    say(f"Medians of {repeats} repeats on {here} processors.")
    say(advised)


def _medians(title: str, rows: Sequence[tuple[Any, ...]], columns: Sequence[str]) -> Table:
    listing = table(title, *columns)
    for row in rows:
        shown = row[: len(columns)]
        listing.add_row(*(f"{x:.2f}" if isinstance(x, float) else str(x) for x in shown))
    return listing


def _numbers(
    text: str, option: str, *, at_least: int, at_most: int | None = None
) -> tuple[int, ...]:
    values = listed(text, int, option, expected="whole numbers such as 8,16")
    taken = f"from {at_least}" + ("" if at_most is None else f" to {at_most}")
    for value in values:
        if value < at_least or (at_most is not None and value > at_most):
            raise UsageError(f"{option} takes numbers {taken}, not {value}")
    return tuple(dict.fromkeys(values))


def _chosen(text: str, choices: Sequence[C], option: str) -> tuple[C, ...]:
    known = {str(choice): choice for choice in choices}
    names = listed(text, str, option, expected=" or ".join(known))
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UsageError(f"{option} takes {' or '.join(known)}, not {unknown[0]!r}")
    return tuple(known[name] for name in dict.fromkeys(names))


def _check(question: Question) -> None:
    """Refuse what cannot be measured here."""
    if max(question.dims) >= min(question.dimensions):
        raise UsageError(
            f"--dim {max(question.dims)} does not fit --n {min(question.dimensions)}: a template "
            "has fewer dimensions than its embeddings have numbers"
        )
    if question.device is not None:
        if question.threads is not None:
            raise UsageError("--threads counts the processor's threads: leave it out with --device")
        try:
            require_device(question.device)
        except TemplateError as error:
            raise UsageError(f"{error}; leave out --device to measure the processor") from None
        return
    needed, there = memory_needed(question), _memory()
    if there is not None and needed > there:
        raise UsageError(
            f"the largest problem needs about {needed / 2**30:.1f} GiB, and this machine has "
            f"{there / 2**30:.1f}: {_SMALLER}"
        )


def _memory() -> int | None:
    """Bytes of memory of this machine, where it says so."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None


def _listing(question: Question, rows: Sequence[Row]) -> Table:
    listing = table(
        f"{question.count} × {question.count} distances in float32",
        *("n", "m", "mode", "metric", "product, ms", "distances, ms", "× product", "authors"),
    )
    for row in rows:
        shown: dict[str, Any] = row.to_json()
        listing.add_row(
            *(str(shown[name]) for name in ("n", "m", "mode", "metric")),
            f"{shown['product_ms']:.1f}",
            f"{shown['distances_ms']:.1f}",
            f"{shown['ratio_to_product']:.2f} ({shown['ratio_to_product_low']:.2f}-"
            f"{shown['ratio_to_product_high']:.2f})",
            f"{shown['authors_to_distances']:.1f} ×",
        )
    return listing
