"""``veilface bench models``: with which settings a pack answers soonest, and with which most often.

Whole photos are timed from their bytes to their embedding, sent by several callers at once through
as many compute slots as a service would have, all settings in turn.
"""

import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from api.cli.bulk import listed_numbers
from api.cli.console import demo_notice, progress
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_photos
from api.cli.options import reports
from api.cli.results import Result
from api.settings import MAX_ONNX_THREADS, Settings, processors
from models.errors import ModelError
from models.pack import ModelPack

PHOTOS_EACH = 4
"""Photos that each caller sends in one repeat."""
MOST_PHOTOS = 100
# What a photo costs is asked, not whether the gate lets it pass.
_embed = partial(ModelPack.embed_photo, policy=None, quality=None)


@dataclass(frozen=True)
class Row:
    """Whole photos with one setting: medians over the repeats.

    ``p50_ms`` is the time from a call to its embedding, the wait for a slot included.
    """

    callers: int
    onnx_threads: int
    compute_slots: int
    photos_per_s: float
    p50_ms: float
    cpu_ms: float


@reports("pack", "providers")
def models(
    photos: Annotated[list[Path], typer.Argument(help="Photos with a face.")],
    *,
    settings: Settings,
    threads: Annotated[str, typer.Option(help="Values of `onnx_threads` to try.")] = "1,2,4",
    repeats: Annotated[int, typer.Option(min=1, help="Timed repeats, of which medians.")] = 9,
) -> Result:
    """Time a pack, and say which `onnx_threads` and `compute_slots` suit this machine.

    Run it where the service will run, while little else runs there. Whole photos are timed with one
    caller, one for each processor, and twice as many. Takes some minutes.

    Example: `veilface bench models anna-1.jpg anna-2.jpg --pack ~/.insightface/models/buffalo_l`
    """
    if settings.pack is None:
        raise UsageError("a pack is what is timed; name it with --pack")
    here = processors()
    packs = {
        count: ModelPack.load(settings.pack, providers=settings.providers, threads=count)
        for count in listed_numbers(threads, "--threads", most=MAX_ONNX_THREADS)
    }
    one = next(iter(packs.values()))
    data = read_photos(photos, most=MOST_PHOTOS)
    for path, photo in zip(photos, data, strict=True):
        try:
            _embed(one, photo)
        except ModelError as error:
            raise CommandError(f"{path}: {error}") from None
    keys = [
        (callers, count, slots)
        for callers, count in product(sorted({1, here, 2 * here}), packs)
        # Further slots than callers would stay empty.
        for slots in sorted({min(callers, max(1, s)) for s in (here // 2, here, 2 * here)})
    ]
    loads = np.empty((repeats + 1, len(keys), 3))
    with progress("measuring", loads.shape[0] * len(keys)) as done:
        for turn in loads:
            for place, (callers, count, slots) in enumerate(keys):
                turn[place] = _load(packs[count], data, callers=callers, slots=slots)
                done(1)
    # The first round only fetches code and memory.
    medians = np.median(loads[1:], axis=0).tolist()
    rows = [Row(*key, *median) for key, median in zip(keys, medians, strict=True)]
    return Result(
        {
            "pack": one.info.name,
            "processors": here,
            "providers": settings.providers,
            "repeats": repeats,
            "photos": rows,
            "advice": advice(rows),
            **demo_notice(one.info),
        }
    )


def advice(rows: Sequence[Row]) -> str:
    """Say which settings answer most photos a second at full load, and one photo soonest."""
    full = [row for row in rows if row.callers == max(row.callers for row in rows)]
    most = max(full, key=lambda row: row.photos_per_s)
    soonest = min((row for row in rows if row.callers == 1), key=lambda row: row.p50_ms)
    return (
        f"onnx_threads = {most.onnx_threads} and compute_slots = {most.compute_slots} answer most "
        f"photos a second here ({most.photos_per_s:.1f}); onnx_threads = {soonest.onnx_threads} "
        f"answers a single photo soonest ({soonest.p50_ms:.1f} ms)."
    )


def _load(
    pack: ModelPack, photos: Sequence[bytes], *, callers: int, slots: int
) -> tuple[float, float, float]:
    """Embed each photo equally often; photos a second, median ms of a call, processor ms."""
    calls = [*photos] * -(-callers * PHOTOS_EACH // len(photos))
    # Calls get the next free slot in order of coming, as in the service.
    with ThreadPoolExecutor(slots) as computing, ThreadPoolExecutor(callers) as calling:

        def call(photo: bytes) -> float:
            start = time.perf_counter()
            computing.submit(_embed, pack, photo).result()
            return (time.perf_counter() - start) * 1000

        wall, cpu = time.perf_counter(), time.process_time()
        times = list(calling.map(call, calls))
        spent = time.perf_counter() - wall, (time.process_time() - cpu) * 1000
    return len(calls) / spent[0], statistics.median(times), spent[1] / len(calls)
