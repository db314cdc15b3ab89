"""All distances of 1000 probes to 1000 templates, beside the products they start from and NumPy.

The first figures are those of ``veilface bench distances``. The last divides the time for a pair
of the specification in float64 (``templates.distances.exact``), on 100 probes and templates, by
that of the kernels on all of them. Prints the table of docs/measurements.md, and the machine.

Example
-------
::

    python -m benchmarks.distances --n 512 --dim 2,4,8,16
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from api.cli.distance_bench import (
    Question,
    Row,
    face_like,
    face_like_templates,
    machine,
    measure,
)
from templates.distances import Metric, pairwise_distances
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from verify.evaluation.units import Mode

_SLICE = 100
_RUNS = 3


def reference_ns(n: int, m: int, mode: Mode, metric: Metric, *, size: int = _SLICE) -> float:
    """Nanoseconds for a pair of the specification, its median of three runs."""
    stream = Keystream.seeded("distance reference", n, m)
    templates = face_like_templates(size, m, n, stream=stream)
    probes: NDArray[np.float32] | SubspaceBatch = (
        face_like(size, n, stream=stream)
        if mode is Mode.POINT
        else face_like_templates(size, m, n, stream=stream)
    )
    times = []
    for _ in range(_RUNS):
        start = time.perf_counter_ns()
        pairwise_distances(probes, templates, metric=metric, dtype=np.float64)
        times.append((time.perf_counter_ns() - start) / size**2)
    return statistics.median(times)


def table(rows: Sequence[Row], count: int, reference: Callable[[Row], float]) -> str:
    """Rows of one n, m and mode side by side in Markdown.

    Parameters
    ----------
    rows
        As `measure` gives them.
    count
        Probes, and templates.
    reference
        Nanoseconds for a pair of the specification.
    """
    lines = [
        "| n | m | mode | metric | points, ms | product, ms | distances, ms | × product | × points "
        "| ns a pair | specification |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        medians = row.medians
        pair = medians.distances * 1e6 / count**2
        ratios = row.to_product
        lines.append(
            f"| {row.n} | {row.m} | {row.mode} | {row.metric} | {medians.points:.1f} "
            f"| {medians.product:.1f} | {medians.distances:.1f} "
            f"| {statistics.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f}) "
            f"| {statistics.median(row.to_points):.1f} | {pair:.0f} "
            f"| {reference(row) / pair:.1f} × |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--n", type=_numbers, default=(128, 512))
    parser.add_argument("--dim", type=_numbers, default=(2, 4, 8, 16))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=None)
    given = parser.parse_args()
    question = Question(
        count=given.count,
        dimensions=given.n,
        dims=given.dim,
        repeats=given.repeats,
        threads=given.threads,
    )
    rows = measure(question)
    print(", ".join(f"{key}: {value}" for key, value in machine(question).items()), "\n")
    print(table(rows, given.count, lambda row: reference_ns(row.n, row.m, row.mode, row.metric)))


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


if __name__ == "__main__":
    main()
