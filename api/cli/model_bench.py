"""With which settings a pack answers soonest on this machine, and with which most often.

Each graph is timed alone, and whole photos from their bytes to their embedding, sent by several
callers at once through as many compute slots as a service would have. What is compared is timed in
turn, so that what else the machine does meets it alike.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from api.cli.errors import CommandError
from api.settings import Settings, processors
from models.errors import ModelError
from models.pack import ModelPack
from models.pack_graphs import PackGraph, locate, pick, read_graph
from models.sessions import Optimisation, Session
from models.synthetic import draw_face, encode_photo

Advance = Callable[[int], None]

DEFAULT_THREADS: int = Settings.model_fields["onnx_threads"].default
# Runs of a graph in one repeat, and photos of each caller.
_RUNS = 5
_PHOTOS_EACH = 4
# Photos that are drawn, of so many people at most: a detector does not take each for a face.
_DRAWN, _PEOPLE = 4, 40
# What a photo costs is asked, not whether the gate lets it pass.
_embed = partial(ModelPack.embed_photo, policy=None, quality=None)


class GraphRow(NamedTuple):
    """One graph: medians, in milliseconds and as ratios to the defaults in the same repeat."""

    file: str
    role: str
    onnx_threads: int
    optimisation: Optimisation
    wall_ms: float
    cpu_ms: float
    wall_ratio: float
    cpu_ratio: float


class PhotoRow(NamedTuple):
    """Whole photos: medians over the repeats.

    ``compute_slots`` is at most ``callers``, since further slots would stay empty. ``p50_ms`` is
    the time from a call to its embedding, the wait for a slot included; ``processors_used`` is
    how many processors computed at the same time.
    """

    callers: int
    onnx_threads: int
    compute_slots: int
    photos_per_s: float
    p50_ms: float
    cpu_ms: float
    processors_used: float
    photos_per_s_low: float
    photos_per_s_high: float
    photos_per_s_repeats: Sequence[float]
    p50_ms_repeats: Sequence[float]


@dataclass(frozen=True)
class ModelBench:
    """What is timed: a pack on photos, or on drawn ones where there are none.

    Parameters
    ----------
    photos
        File name to content.
    threads
        Threads of one inference, tried beside the default.
    """

    path: Path
    providers: Sequence[str]
    threads: Sequence[int]
    repeats: int
    photos: Mapping[str, bytes]

    @cached_property
    def packs(self) -> dict[int, ModelPack]:
        """The pack for each number of threads."""
        return {
            threads: ModelPack.load(self.path, providers=self.providers, threads=threads)
            for threads in sorted({DEFAULT_THREADS, *self.threads})
        }

    @property
    def pack(self) -> ModelPack:
        """The pack as a service has it by default."""
        return self.packs[DEFAULT_THREADS]

    @property
    def settings(self) -> list[tuple[int, int, int]]:
        """Callers, threads and slots that are compared."""
        here = processors()
        return [
            (callers, threads, slots)
            for callers, threads in product(sorted({1, here, 2 * here}), self.packs)
            for slots in sorted(
                {min(callers, max(1, s)) for s in (here // threads, here // 2, here, 2 * here)}
            )
        ]

    @cached_property
    def graphs(self) -> list[tuple[PackGraph, int, int]]:
        """Detector, embedder and liveness graphs, with height and width of what they are fed."""
        location, stated = locate(self.path)
        graphs = {file.name: read_graph(file, stated) for file in location.files}
        embedder, detector = pick(list(graphs.values()), location.folder)
        sizes = {embedder.path.name: (self.pack.crop_size, self.pack.crop_size)}
        if detector is not None and self.pack.info.detector is not None:
            sizes = {detector.path.name: self.pack.info.detector.input_size, **sizes}
        for member in self.pack.liveness.members if self.pack.liveness else ():
            sizes[member.file] = (member.expects.size, member.expects.size)
        return [(graphs[name], *size) for name, size in sizes.items()]

    @property
    def rounds(self) -> int:
        """How often the measurements report progress, taken together."""
        return (len(self.graphs) + len(self.settings)) * (self.repeats + 1)

    def time_graphs(self, progress: Advance) -> list[GraphRow]:
        """Time each graph on noise; its first round only fetches code and memory."""
        return [row for graph in self.graphs for row in self._rows(*graph, progress)]

    def _rows(self, graph: PackGraph, height: int, width: int, progress: Advance) -> list[GraphRow]:
        image = graph.signature.inputs[0]
        noise = np.random.default_rng(0).standard_normal((image.shape[0] or 1, 3, height, width))
        feeds = {image.name: noise.astype(np.float32)}
        make = partial(Session, graph.model, name=graph.path.name, providers=self.providers)
        sessions = {
            (threads, level): make(threads=threads, optimisation=level)
            for threads, level in product(self.packs, get_args(Optimisation))
        }
        seen: dict[tuple[int, Optimisation], list[tuple[float, float]]] = {k: [] for k in sessions}
        for _ in range(self.repeats + 1):
            for key, session in sessions.items():
                wall, cpu = time.perf_counter(), time.process_time()
                for _ in range(_RUNS):
                    session.run(feeds)
                spent = time.perf_counter() - wall, time.process_time() - cpu
                seen[key].append((spent[0] * 1000 / _RUNS, spent[1] * 1000 / _RUNS))
            progress(1)
        times = {key: np.array(costs[1:]) for key, costs in seen.items()}
        defaults = times[DEFAULT_THREADS, "all"]
        return [
            GraphRow(
                graph.path.name,
                str(graph.role),
                *key,
                *np.median(np.hstack([costs, costs / defaults]), axis=0).tolist(),
            )
            for key, costs in times.items()
        ]

    def time_photos(self, progress: Advance) -> list[PhotoRow]:
        """Time photos with all settings; the first round only fetches code and memory.

        Raises
        ------
        CommandError
            A photo cannot be embedded, or the pack sees no face in what is drawn.
        """
        photos = self._taken()
        seen: dict[tuple[int, int, int], list[tuple[float, float, float]]]
        seen = {key: [] for key in self.settings}
        for _ in range(self.repeats + 1):
            for (callers, threads, slots), loads in seen.items():
                loads.append(_load(self.packs[threads], photos, callers=callers, slots=slots))
                progress(1)
        rows = []
        for key, loads in seen.items():
            rates, waits, costs = zip(*loads[1:], strict=True)
            rate, p50, cpu = map(statistics.median, (rates, waits, costs))
            used = statistics.median(r * c / 1000 for r, c in zip(rates, costs, strict=True))
            rows.append(PhotoRow(*key, rate, p50, cpu, used, min(rates), max(rates), rates, waits))
        return rows

    def _taken(self) -> list[bytes]:
        for name, photo in self.photos.items():
            try:
                _embed(self.pack, photo)
            except ModelError as error:
                raise CommandError(f"{name}: {error}") from error
        return list(self.photos.values()) or _drawn(self.pack)


def advice(rows: Sequence[PhotoRow]) -> str:
    """Say which settings answer most photos a second at full load, and one photo soonest.

    Medians decide. Where the best was not ahead of the defaults in every repeat, that is said.
    """
    full = [row for row in rows if row.callers == max(row.callers for row in rows)]
    single = [row for row in rows if row.callers == 1]
    most = max(full, key=lambda row: row.photos_per_s)
    soonest = min(single, key=lambda row: row.p50_ms)
    usual = next(row for row in full if row[1:3] == (DEFAULT_THREADS, processors()))
    alone = next(row for row in single if row.onnx_threads == DEFAULT_THREADS)
    many, one = f"{most.photos_per_s:.1f}", f"{soonest.p50_ms:.1f} ms"
    if most is not usual:
        pairs = zip(most.photos_per_s_repeats, usual.photos_per_s_repeats, strict=True)
        many += f"; {usual.photos_per_s:.1f} with the defaults{_doubt(pairs)}"
    if soonest is not alone:
        pairs = zip(alone.p50_ms_repeats, soonest.p50_ms_repeats, strict=True)
        one += f"; {alone.p50_ms:.1f} ms with the default{_doubt(pairs)}"
    return (
        f"onnx_threads = {most.onnx_threads} and compute_slots = {most.compute_slots}"
        f"{', the defaults,' if most is usual else ''} answer most photos a second here ({many}); "
        f"onnx_threads = {soonest.onnx_threads}{', the default,' if soonest is alone else ''} "
        f"answers a single photo soonest ({one})."
    )


def _doubt(pairs: Iterable[tuple[float, float]]) -> str:
    return "" if all(first > second for first, second in pairs) else ", not in every repeat"


def _load(
    pack: ModelPack, photos: Sequence[bytes], *, callers: int, slots: int
) -> tuple[float, float, float]:
    """Embed each photo equally often; photos a second, median ms of a call, processor ms."""
    calls = [*photos] * -(-callers * _PHOTOS_EACH // len(photos))
    # Who waits gets the next free slot in order of coming, as in the service.
    with ThreadPoolExecutor(slots) as computing, ThreadPoolExecutor(callers) as calling:

        def call(photo: bytes) -> float:
            start = time.perf_counter()
            computing.submit(_embed, pack, photo).result()
            return (time.perf_counter() - start) * 1000

        wall, cpu = time.perf_counter(), time.process_time()
        times = list(calling.map(call, calls))
        spent = time.perf_counter() - wall, (time.process_time() - cpu) * 1000
    return len(calls) / spent[0], statistics.median(times), spent[1] / len(calls)


def _drawn(pack: ModelPack) -> list[bytes]:
    """Photos of people who do not exist; aligned where the pack has no detector."""
    if pack.info.detector is None:
        return [encode_photo(draw_face(who, size=pack.crop_size)) for who in range(_DRAWN)]
    photos: list[bytes] = []
    for who in range(_PEOPLE):
        picture = np.pad(draw_face(who, size=224), ((128, 128), (208, 208), (0, 0)), "edge")
        if pack.detect(picture):
            photos.append(encode_photo(picture))
        if len(photos) == _DRAWN:
            return photos
    raise CommandError("the pack's detector sees no face in drawn photos; name others with --photo")
