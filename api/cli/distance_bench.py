"""How long distances take, beside the matrix products that no distance can do without.

A distance starts from the products of stacked rows (docs/distances.md "The way of a pair"). Each of
them in one matrix of its own, made by the matrix library, is the *bare product*; the products of
the descriptors alone are the *point-to-point* matrix, which a comparison of raw descriptors costs.
All three are timed in turn, so that what else the machine does meets them alike, and compared
repeat by repeat. Each has the machine to itself: neither meets threads that are left over from the
other.
"""

import platform
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module, metadata
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController, threadpool_limits

from api.settings import processors
from templates.contract.canonical import Json
from templates.distances import (
    DEFAULT_STEPS,
    Metric,
    pairwise_distances,
    require_device,
    warm_up,
)
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from verify.evaluation.units import Mode

Array32 = NDArray[np.float32]
Task = Callable[[], object]

MODES = (Mode.POINT, Mode.SUBSPACE)

# Of the bare product, which is made in bands of rows where it is larger: the largest of the default
# sizes, 17,000 × 17,000, is one piece.
_BAND_BYTES = 5 << 28
# Seconds in which the matrix library's threads go to sleep: after a product they turn on the spot
# for 100 ms, and would take a processor from the distances.
_REST = 0.2
# Milliseconds beside which it does not count that threads have to wake up.
_LONG = 200


@dataclass(frozen=True)
class Question:
    """What is measured: every mode and metric at every n and m."""

    count: int
    """Probes, and templates."""
    dimensions: Sequence[int]
    """Numbers n of a descriptor."""
    dims: Sequence[int]
    """Dimensions m of the subspaces, each below every n."""
    modes: Sequence[Mode] = MODES
    metrics: Sequence[Metric] = tuple(Metric)
    repeats: int = 5
    threads: int | None = None
    """Of the matrix library and of the kernels; by default as many as the library has."""
    device: str | None = None
    """Of torch; by default the processor, without torch."""
    seed: int = 0

    @property
    def rounds(self) -> int:
        """How often :func:`measure` reports progress: once, and at every repeat, timed or not."""
        cells = len(self.dimensions) * len(self.dims) * len(self.modes) * len(self.metrics)
        return 1 + cells * (self.repeats + 1)


class Repeat(NamedTuple):
    """One repeat, in milliseconds."""

    points: float
    product: float
    distances: float


@dataclass(frozen=True)
class Row:
    """The distances of one mode and metric at one n and m."""

    n: int
    m: int
    mode: Mode
    metric: Metric
    repeats: tuple[Repeat, ...]

    @property
    def medians(self) -> Repeat:
        """Median times in milliseconds."""
        return Repeat(*(statistics.median(times) for times in zip(*self.repeats, strict=True)))

    @property
    def to_product(self) -> list[float]:
        """Times of the distances as multiples of the bare product, repeat by repeat."""
        return [repeat.distances / repeat.product for repeat in self.repeats]

    @property
    def to_points(self) -> list[float]:
        """Times of the distances as multiples of the point-to-point matrix, repeat by repeat."""
        return [repeat.distances / repeat.points for repeat in self.repeats]

    def to_json(self) -> dict[str, Json]:
        """Medians, ratios and every single time."""
        medians = self.medians
        return {
            "n": self.n,
            "m": self.m,
            "mode": str(self.mode),
            "metric": str(self.metric),
            "points_ms": medians.points,
            "product_ms": medians.product,
            "distances_ms": medians.distances,
            "ratio_to_product": statistics.median(self.to_product),
            "ratio_to_product_low": min(self.to_product),
            "ratio_to_product_high": max(self.to_product),
            "ratio_to_points": statistics.median(self.to_points),
            "repeats": [
                {
                    "points_ms": repeat.points,
                    "product_ms": repeat.product,
                    "distances_ms": repeat.distances,
                }
                for repeat in self.repeats
            ],
        }


def measure(question: Question, *, progress: Callable[[int], None] = lambda _: None) -> list[Row]:
    """Time the distances and the two products of every n, m, mode and metric.

    Parameters
    ----------
    progress
        Called with 1 as often as ``question.rounds`` says.

    Raises
    ------
    TemplateError
        The device cannot be used.
    MemoryError
        The device has too little memory.
    """
    if question.device is None:
        warm_up()
    else:
        require_device(question.device)
    progress(1)
    rows: list[Row] = []
    with threadpool_limits(limits=question.threads, user_api="blas"):
        for n, m in product(question.dimensions, question.dims):
            stream = Keystream.seeded("distance bench", question.seed, n, m)
            templates = face_like_templates(question.count, m, n, stream=stream)
            for mode in question.modes:
                probes: Array32 | SubspaceBatch = (
                    face_like(question.count, n, stream=stream)
                    if mode is Mode.POINT
                    else face_like_templates(question.count, m, n, stream=stream)
                )
                tasks = _tasks(probes, templates, question)
                for metric, repeats in _interleaved(tasks, question, progress).items():
                    rows.append(Row(n, m, mode, metric, repeats))
    return rows


def face_like(count: int, n: int, *, stream: Keystream) -> Array32:
    """Descriptors of nobody, (count, n) unit rows spread like faces: a mean, a steep spectrum."""
    scales = 1 / np.sqrt(1 + np.arange(n) / 8)
    rows = stream.normal((count, n)) * scales + 0.3 * (np.arange(n) == 0)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    descriptors: Array32 = rows.astype(np.float32)
    return descriptors


def face_like_templates(count: int, m: int, n: int, *, stream: Keystream) -> SubspaceBatch:
    """Templates of such descriptors, each with m others as decoys of its own."""
    members = face_like(count * (m + 1), n, stream=stream).reshape(count, m + 1, n)
    return SubspaceBatch.through(members[:, 0], members[:, 1:] - members[:, :1], stream=stream)


def memory_needed(question: Question) -> int:
    """Bytes that the largest problem holds at most, roughly."""
    count, n, m = question.count, max(question.dimensions), max(question.dims)
    lifted = Mode.SUBSPACE in question.modes
    numbers = count * (m + 1)
    # Templates and their stacked rows in float32; while one side is made, several float64 copies.
    inputs = (2 if lifted else 1) * 2 * 4 * numbers * n + 4 * 8 * numbers * n
    return inputs + _band_bytes(numbers if lifted else count, numbers) + 2 * 4 * count * count


def machine(question: Question) -> dict[str, Json]:
    """Facts that a time means nothing without."""
    libraries = ThreadpoolController().select(user_api="blas").lib_controllers
    # Other packages bring a matrix library of their own; the products are NumPy's.
    own = [library for library in libraries if "numpy" in library.filepath] or libraries
    names = [f"{library.internal_api} {library.version} ({_kind(library)})" for library in own]
    facts: dict[str, Json] = {
        "processors": processors(),
        "architecture": platform.machine(),
        "matrix_library": ", ".join(names),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": metadata.version("numba"),
        "device": question.device,
    }
    if question.device is None:
        available = max((library.num_threads for library in libraries), default=1)
        return {**facts, "threads": question.threads or available}
    torch = import_module("torch")
    kind = torch.device(question.device).type
    named = torch.cuda.get_device_name(question.device) if kind == "cuda" else kind
    return {**facts, "device_name": named, "torch": torch.__version__}


def _kind(library: Any) -> str:
    """Processor that a library has chosen its code for, where it says so."""
    return str(getattr(library, "architecture", None) or "no architecture named")


class _Tasks(NamedTuple):
    """What is timed; each returns when its result is there."""

    points: Task
    product: Task
    distances: Mapping[Metric, Task]


def _interleaved(
    tasks: _Tasks, question: Question, progress: Callable[[int], None]
) -> dict[Metric, tuple[Repeat, ...]]:
    """Time each task in turn; the first round only fetches code and memory."""
    seen: dict[Metric, list[Repeat]] = {metric: [] for metric in question.metrics}
    for index in range(question.repeats + 1):
        for metric, repeats in seen.items():
            points, whole = _milliseconds(tasks.points), _milliseconds(tasks.product)
            time.sleep(_REST)
            if index:
                repeats.append(Repeat(points, whole, _milliseconds(tasks.distances[metric])))
            else:
                tasks.distances[metric]()
            progress(1)
    return {metric: tuple(repeats) for metric, repeats in seen.items()}


def _milliseconds(task: Task) -> float:
    """Time a task; a short one at its second run, when its threads and memory are awake."""
    first = _once(task)
    return first if first > _LONG else _once(task)


def _once(task: Task) -> float:
    start = time.perf_counter_ns()
    task()
    return (time.perf_counter_ns() - start) / 1e6


def _tasks(probes: Array32 | SubspaceBatch, templates: SubspaceBatch, question: Question) -> _Tasks:
    make = _on_processor if question.device is None else _on_device
    return make(probes, templates, question)


def _on_processor(
    probes: Array32 | SubspaceBatch, templates: SubspaceBatch, question: Question
) -> _Tasks:
    left, right = _stacked(probes), _stacked(templates)
    feet = probes.feet if isinstance(probes, SubspaceBatch) else probes
    bands = list(_bands(len(left), len(right)))
    table = np.empty((len(feet), len(templates)), dtype=np.float32)
    out = np.empty((len(left[bands[0]]), len(right)), dtype=np.float32)

    def points() -> None:
        np.matmul(feet, templates.feet.T, out=table)

    def whole() -> None:
        for band in bands:
            part = left[band]
            np.matmul(part, right.T, out=out[: len(part)])

    distances = {
        metric: partial(
            pairwise_distances, probes, templates, metric=metric, threads=question.threads
        )
        for metric in question.metrics
    }
    return _Tasks(points, whole, distances)


def _on_device(
    probes: Array32 | SubspaceBatch, templates: SubspaceBatch, question: Question
) -> _Tasks:
    """The same with tensors that are on the device before the time begins."""
    import torch

    from templates.distances.torch import SubspaceTensors, ieee_products, pairwise, stacked

    device = torch.device(question.device or "cpu")
    synchronise: Task = torch.get_device_module(device).synchronize

    def finished(task: Task) -> Task:
        def run() -> None:
            try:
                task()
                synchronise()
            except torch.OutOfMemoryError as error:
                raise MemoryError(f"on {device}") from error

        return run

    def prepared() -> _Tasks:
        template_tensors = SubspaceTensors.of(templates, device)
        probe_tensors: Any = (
            SubspaceTensors.of(probes, device)
            if isinstance(probes, SubspaceBatch)
            else torch.tensor(probes, device=device)
        )
        feet = probe_tensors.feet if isinstance(probe_tensors, SubspaceTensors) else probe_tensors
        left, right = stacked(probe_tensors), stacked(template_tensors)
        bands = list(_bands(len(left), len(right)))
        table = torch.empty(len(feet), len(template_tensors), device=device)
        out = torch.empty(len(left[bands[0]]), len(right), device=device)

        def points() -> None:
            with ieee_products(device):
                torch.matmul(feet, template_tensors.feet.T, out=table)

        def whole() -> None:
            with ieee_products(device):
                for band in bands:
                    part = left[band]
                    torch.matmul(part, right.T, out=out[: len(part)])

        distances = {
            metric: finished(
                partial(
                    pairwise, probe_tensors, template_tensors, metric=metric, steps=DEFAULT_STEPS
                )
            )
            for metric in question.metrics
        }
        return _Tasks(finished(points), finished(whole), distances)

    try:
        return prepared()
    except torch.OutOfMemoryError as error:
        raise MemoryError(f"on {device}") from error


def _stacked(side: Array32 | SubspaceBatch) -> Array32:
    """Rows whose products with those of another side are the Gram matrix."""
    if not isinstance(side, SubspaceBatch):
        return side
    return np.concatenate([side.feet[:, None], side.bases], axis=1).reshape(-1, side.n)


def _parts(rows: int, columns: int) -> int:
    return max(1, -(-4 * rows * columns // _BAND_BYTES))


def _band_bytes(rows: int, columns: int) -> int:
    return 4 * columns * -(-rows // _parts(rows, columns))


def _bands(rows: int, columns: int) -> Iterator[slice]:
    """Equal parts of a product's rows, the first the largest."""
    step = -(-rows // _parts(rows, columns))
    return (slice(start, min(start + step, rows)) for start in range(0, rows, step))
