"""How long distances take, beside the matrix product that they cannot do without.

A distance starts from the products of stacked rows (docs/contributing.md "Distances"). All of
them in one matrix of its own is the *bare product*. The distances and the product are timed in
turn, so that what else the machine does meets them alike, and compared repeat by repeat. Beside
them stands the paper's formula as its authors compute it, on fewer pairs.
"""

import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from api.settings import processors
from templates.contract.canonical import Json
from templates.distances import (
    Metric,
    Probes,
    on_device,
    pairwise_distances,
    require_device,
    warm_up,
)
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from verify.evaluation.units import Mode

Array32 = NDArray[np.float32]

MODES = (Mode.POINT, Mode.SUBSPACE)

# Seconds in which the matrix library's threads go to sleep: after a product they turn on the spot
# for 100 ms, and would take a processor from the distances.
_REST = 0.2
# Milliseconds beside which it does not count that threads have to wake up.
_LONG = 200
# Probes, and templates, of the authors' formula.
_AUTHORS_COUNT = 100


@dataclass(frozen=True)
class Question:
    """What is measured: every mode and metric at every n and m."""

    count: int
    """Probes, and templates."""
    dimensions: Sequence[int]
    """Numbers n of an embedding."""
    dims: Sequence[int]
    """Dimensions m of the subspaces, each below every n."""
    modes: Sequence[Mode] = MODES
    metrics: Sequence[Metric] = tuple(Metric)
    repeats: int = 5
    threads: int | None = None
    """Of the matrix library and of the distances; by default as many as the library has."""
    device: str | None = None
    """Of torch; by default the processor, without torch."""
    seed: int = 0

    @property
    def cells(self) -> int:
        """How often :func:`measure` reports progress."""
        return len(self.dimensions) * len(self.dims) * len(self.modes) * len(self.metrics)


class Repeat(NamedTuple):
    """One repeat, in milliseconds for all pairs."""

    product: float
    distances: float
    authors: float


@dataclass(frozen=True)
class Row:
    """The distances of one mode and metric at one n and m."""

    n: int
    m: int
    mode: Mode
    metric: Metric
    repeats: tuple[Repeat, ...]

    def to_json(self) -> dict[str, Json]:
        """Medians, ratios inside a repeat, and every single time."""
        medians = Repeat(*(statistics.median(times) for times in zip(*self.repeats, strict=True)))
        to_product = [repeat.distances / repeat.product for repeat in self.repeats]
        authors = [repeat.authors / repeat.distances for repeat in self.repeats]
        return {
            "n": self.n,
            "m": self.m,
            "mode": str(self.mode),
            "metric": str(self.metric),
            **{f"{name}_ms": value for name, value in medians._asdict().items()},
            "ratio_to_product": statistics.median(to_product),
            "ratio_to_product_low": min(to_product),
            "ratio_to_product_high": max(to_product),
            "authors_to_distances": statistics.median(authors),
            "repeats": [
                {f"{name}_ms": value for name, value in repeat._asdict().items()}
                for repeat in self.repeats
            ],
        }


def measure(question: Question, *, progress: Callable[[int], None] = lambda _: None) -> list[Row]:
    """Time the distances, the product and the authors' formula of every n, m, mode and metric.

    Raises
    ------
    TemplateError
        The device cannot be used, or the extra ``evaluate`` is not installed.
    """
    if question.device is None:
        warm_up()
    else:
        require_device(question.device)
    rows = []
    with (
        threadpool_limits(limits=question.threads, user_api="blas"),
        on_device(question.device),
    ):
        for n, m, mode in product(question.dimensions, question.dims, question.modes):
            stream = Keystream.seeded("distance bench", question.seed, n, m)
            templates = face_like_templates(question.count, m, n, stream=stream)
            probes: Probes = (
                face_like(question.count, n, stream=stream)
                if mode is Mode.POINT
                else face_like_templates(question.count, m, n, stream=stream)
            )
            for metric in question.metrics:
                rows.append(Row(n, m, mode, metric, _repeats(probes, templates, metric, question)))
                progress(1)
    return rows


def _repeats(
    probes: Probes, templates: SubspaceBatch, metric: Metric, question: Question
) -> tuple[Repeat, ...]:
    """Time each in turn; the first round only fetches code and memory."""
    left, right = _stacked(probes), _stacked(templates)
    table = np.empty((len(left), len(right)), dtype=np.float32)
    some = slice(min(_AUTHORS_COUNT, len(templates)))
    share = (len(templates) / some.stop) ** 2
    repeats = []
    for _ in range(question.repeats + 1):
        whole = _milliseconds(lambda: np.matmul(left, right.T, out=table))
        time.sleep(_REST)
        distances = _milliseconds(
            lambda: pairwise_distances(probes, templates, metric=metric, threads=question.threads)
        )
        authors = _milliseconds(lambda: authors_distances(probes[some], templates[some])) * share
        repeats.append(Repeat(whole, distances, authors))
    return tuple(repeats[1:])


def authors_distances(probes: Probes, templates: SubspaceBatch) -> Array32:
    """Euclidean distances by the formulas of the paper (eq. 1 and 5), as its authors compute them.

    Pair by pair from the closest points, whose coefficients are found by the inverse of a matrix;
    it is singular where two subspaces share two decoys, and the result is then anything.
    """
    feet, bases = templates.feet, templates.bases
    out = np.empty((len(probes), len(templates)), dtype=np.float32)
    for i in range(len(out)):
        if isinstance(probes, SubspaceBatch):
            foot, basis = probes.feet[i], probes.bases[i]
            gaps = feet - foot
            cross = basis @ bases.transpose(0, 2, 1)  # (T, m_D, m_E)
            inside, across = gaps @ basis.T, (bases @ gaps[:, :, None])[:, :, 0]
            system = np.eye(templates.m) - cross.transpose(0, 2, 1) @ cross
            wanted = (cross.transpose(0, 2, 1) @ inside[:, :, None])[:, :, 0] - across
            try:
                beta = (np.linalg.inv(system) @ wanted[:, :, None])[:, :, 0]
            except np.linalg.LinAlgError:
                beta = np.full_like(wanted, np.nan)
            alpha = inside + (cross @ beta[:, :, None])[:, :, 0]
            ends = feet + (beta[:, None] @ bases)[:, 0] - foot - alpha @ basis
        else:
            gaps = probes[i] - feet
            ends = gaps - ((bases @ gaps[:, :, None]).transpose(0, 2, 1) @ bases)[:, 0]
        out[i] = np.linalg.norm(ends, axis=1)
    return out


def face_like(count: int, n: int, *, stream: Keystream) -> Array32:
    """Embeddings of nobody, (count, n) unit rows spread like faces: a mean, a steep spectrum."""
    scales = 1 / np.sqrt(1 + np.arange(n) / 8)
    rows = stream.normal((count, n)) * scales + 0.3 * (np.arange(n) == 0)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    embeddings: Array32 = rows.astype(np.float32)
    return embeddings


def face_like_templates(count: int, m: int, n: int, *, stream: Keystream) -> SubspaceBatch:
    """Templates of such embeddings, each with m others as decoys of its own."""
    members = face_like(count * (m + 1), n, stream=stream).reshape(count, m + 1, n)
    return SubspaceBatch.through(members[:, 0], members[:, 1:] - members[:, :1], stream=stream)


def memory_needed(question: Question) -> int:
    """Bytes that the largest problem holds at most, roughly."""
    count, n, rows = question.count, max(question.dimensions), max(question.dims) + 1
    deep = rows if Mode.SUBSPACE in question.modes else 1
    # Templates and their stacked rows in float32; while one side is made, several float64 copies.
    inputs = count * n * (2 * 4 * (rows + deep) + 4 * 8 * rows)
    return inputs + 4 * count * count * (rows * deep + 2)


def machine(question: Question) -> dict[str, Json]:
    """Facts that a time means nothing without."""
    facts: dict[str, Json] = {
        "processors": processors(),
        "architecture": platform.machine(),
        "python": platform.python_version(),
        "threads": question.threads,
        "device": question.device,
    }
    return facts | {name: metadata.version(name) for name in ("numpy", "numba")}


def _milliseconds(task: Callable[[], object]) -> float:
    """Time a task; a short one at its second run, when its threads and memory are awake."""
    for _ in range(2):
        start = time.perf_counter_ns()
        task()
        taken = (time.perf_counter_ns() - start) / 1e6
        if taken > _LONG:
            break
    return taken


def _stacked(side: Probes) -> NDArray[np.floating]:
    """Rows whose products with those of another side are the Gram matrix."""
    if not isinstance(side, SubspaceBatch):
        return side
    return np.concatenate([side.feet[:, None], side.bases], axis=1).reshape(-1, side.n)
