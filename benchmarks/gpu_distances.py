r"""Distances on a GPU, as ratios to the matrix product that they start from.

Every time is a median of runs between two events of the device, after warm-up, and the product of
the same stacked rows is timed in turn with the distances. Prints a table in Markdown and the same
numbers as JSON. Without a CUDA device it says so and exits with 2.

Example
-------
::

    python -m benchmarks.gpu_distances
"""

import functools
import json
import statistics
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from templates.distances import DEFAULT_STEPS, Metric, pairwise_distances, similarity
from templates.distances.torch import (
    TILE_BYTES,
    SubspaceTensors,
    ieee_products,
    nearest,
    pairwise,
    stacked,
)
from templates.space.subspace import SubspaceBatch

_SIZE = 1000
_MANY = 100_000
_CHECKED = 40
_RUNS = 15
_CHUNK = 4096


def once(task: Callable[[], object]) -> float:
    """Milliseconds between two events of the device around a task."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
    start.record()
    task()
    end.record()
    torch.cuda.synchronize()
    elapsed: float = start.elapsed_time(end)
    return elapsed


def milliseconds(tasks: list[Callable[[], object]], runs: int = _RUNS) -> list[float]:
    """Median time of each task on the device, all tasks in turn."""
    times: list[list[float]] = [[] for _ in tasks]
    for run in range(-3, runs):
        for task, seen in zip(tasks, times, strict=True):
            elapsed = once(task)
            if run >= 0:
                seen.append(elapsed)
    return [statistics.median(seen) for seen in times]


def descriptors(count: int, n: int, generator: torch.Generator) -> Tensor:
    """Unit rows that are spread like faces: a common mean and a steep spectrum."""
    device = generator.device
    scales = 1 / torch.sqrt(1 + torch.arange(n, device=device) / 8)
    rows = torch.randn(count, n, generator=generator, device=device) * scales
    rows[:, 0] += 0.3
    norms: Tensor = torch.linalg.vector_norm(rows, dim=1, keepdim=True)
    return rows / norms


def templates_of(count: int, m: int, n: int, generator: torch.Generator) -> SubspaceTensors:
    """Templates through descriptors and m decoys that are descriptors of others."""
    feet, bases = [], []
    for start in range(0, count, _CHUNK):
        size = min(_CHUNK, count - start)
        rows = descriptors(size * (m + 1), n, generator).view(size, m + 1, n).double()
        point, directions = rows[:, 0], rows[:, 1:] - rows[:, :1]
        span = torch.linalg.qr(directions.mT).Q
        feet.append((point - (span @ (span.mT @ point[:, :, None]))[:, :, 0]).float())
        bases.append(span.mT.float())
    return SubspaceTensors(torch.cat(feet), torch.cat(bases).contiguous())


def largest_error(
    probes: Tensor | SubspaceTensors, templates: SubspaceTensors, metric: Metric
) -> float:
    """Largest difference of similarity to the reference in float64, on a few pairs."""
    some, others = probes[:_CHECKED], templates[:_CHECKED]
    checked = some.cpu().numpy() if isinstance(some, Tensor) else _batch(some)
    expected = pairwise_distances(checked, _batch(others), metric=metric, dtype=np.float64)
    seen = pairwise(some, others, metric=metric, steps=DEFAULT_STEPS).double().cpu().numpy()
    return float(np.abs(similarity(seen) - similarity(expected)).max())


def _batch(templates: SubspaceTensors) -> SubspaceBatch:
    return SubspaceBatch(templates.feet.cpu().numpy(), templates.bases.cpu().numpy())


def matrix(m: int, n: int, device: torch.device) -> list[dict[str, Any]]:
    """Time all distances of 1000 probes to 1000 templates, both modes and both metrics."""
    generator = torch.Generator(device).manual_seed(m * n)
    templates = templates_of(_SIZE, m, n, generator)
    rows = []
    for mode, probes in (
        ("point to subspace", descriptors(_SIZE, n, generator)),
        ("subspace to subspace", templates_of(_SIZE, m, n, generator)),
    ):
        left, right = stacked(probes), stacked(templates).T.contiguous()

        def product(left: Tensor = left, right: Tensor = right) -> Tensor:
            with ieee_products(device):
                return left @ right

        for metric in Metric:

            def distances(probes: Any = probes, metric: Metric = metric) -> Tensor:
                return pairwise(probes, templates, metric=metric, steps=DEFAULT_STEPS)

            bare, whole = milliseconds([product, distances])
            rows.append(
                {
                    "mode": mode,
                    "metric": str(metric),
                    "m": m,
                    "n": n,
                    "product_ms": bare,
                    "distances_ms": whole,
                    "ratio": whole / bare,
                    "largest_error": largest_error(probes, templates, metric),
                }
            )
    return rows


def search(device: torch.device, m: int = 8, n: int = 512) -> list[dict[str, Any]]:
    """Time the nearest of 100,000 templates for 100,000 probes, both modes and both metrics."""
    generator = torch.Generator(device).manual_seed(1)
    templates = templates_of(_MANY, m, n, generator)
    rows = []
    for mode, probes in (
        ("point to subspace", descriptors(_MANY, n, generator)),
        ("subspace to subspace", templates_of(_MANY, m, n, generator)),
    ):
        for metric in Metric:
            search_one = functools.partial(nearest, k=1, metric=metric, steps=DEFAULT_STEPS)
            search_one(probes[:_SIZE], templates[:_SIZE])
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.memory_allocated()
            seconds = once(functools.partial(search_one, probes, templates)) / 1000
            rows.append(
                {
                    "mode": mode,
                    "metric": str(metric),
                    "m": m,
                    "n": n,
                    "seconds": seconds,
                    "pairs_per_second": _MANY**2 / seconds,
                    "memory_mib": (torch.cuda.max_memory_allocated() - before) / 2**20,
                }
            )
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown, their keys as the heading."""
    keys = list(rows[0])
    lines = [f"| {' | '.join(keys)} |", f"|{' --- |' * len(keys)}"]
    for row in rows:
        cells = [
            f"{row[key]:.3g}" if isinstance(row[key], float) else str(row[key]) for key in keys
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> int:
    """Measure and print, or say that there is no device."""
    if not torch.cuda.is_available():
        print("no CUDA device: nothing was measured", file=sys.stderr)
        return 2
    device = torch.device("cuda")
    setting = {
        "device": torch.cuda.get_device_name(device),
        "torch": torch.__version__,
        "tile_mib": TILE_BYTES["cuda"] / 2**20,
    }
    print(", ".join(f"{key}: {value}" for key, value in setting.items()), "\n")
    pairs = [row for n in (128, 512) for m in (2, 4, 8, 16) for row in matrix(m, n, device)]
    print(f"{_SIZE} probes, {_SIZE} templates, all distances:\n\n{table(pairs)}\n", flush=True)
    nearest_one = search(device)
    print(f"{_MANY} probes, {_MANY} templates, the nearest one:\n\n{table(nearest_one)}\n")
    print(json.dumps({"setting": setting, "pairwise": pairs, "nearest": nearest_one}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
