"""``veilface bench distances``: distances beside the matrix product that they cannot do without.

A distance starts from the products of stacked rows (CONTRIBUTING.md, "Distances"). All are timed
in turn, so that what else the machine does meets them alike, and compared repeat by repeat.
"""

import statistics
import time
from collections.abc import Callable
from itertools import product
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from api.cli import flags
from api.cli.bulk import listed_numbers
from api.cli.console import progress
from api.cli.errors import require_extra
from api.cli.options import PROCESSOR, reports, torch_device
from api.cli.results import Result
from api.settings import processors
from templates.distances import Metric, Probes, on_device, pairwise_distances
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
REST_S = 0.2
"""Time for the matrix library's threads to go to sleep: after a product they turn on the spot."""
LONG_MS = 200
"""Milliseconds beside which it does not count that threads have to wake up."""
AUTHORS_COUNT = 100
"""Probes, and templates, of the authors' formula."""


@reports()
def distances(
    *,
    count: Annotated[int, typer.Option(min=1, help="Probes, and templates.")] = 1000,
    n: Annotated[str, typer.Option("--n", help="Numbers in an embedding.")] = "128,512",
    dim: Annotated[str, typer.Option(help="Dimensions m of the subspaces.")] = "2,4,8,16",
    repeats: Annotated[int, typer.Option(min=1, help="Timed repeats, of which medians.")] = 5,
    device: flags.Device = PROCESSOR,
) -> Result:
    """Time all distances between probes and templates, beside the bare matrix product.

    Needs the extra `evaluate`. It draws embeddings of nobody, spread like faces, and lifts them.
    Points are compared with templates (`p2s`), and lifted probes (`s2s`); Euclidean distances are
    the paper's, spherical ones the service's. `to product` is a time as a multiple of the matrix
    product that a distance starts from, in the same repeat, with the smallest and the largest;
    `authors` is the paper's Euclidean formula as its authors compute it, in multiples of our time.
    Times are medians in ms. The default options take some minutes.

    Example: `veilface bench distances --n 512 --dim 16`
    """
    sizes = listed_numbers(n, "--n", least=2)
    dims = listed_numbers(dim, "--dim", most=min(sizes) - 1)
    cells = list(product(sizes, dims, ("p2s", "s2s"), Metric))
    on = torch_device(device)
    if on is None:
        require_extra("evaluate")
    rows = []
    with progress("measuring", len(cells)) as advance, on_device(on):
        for size, m, mode, metric in cells:
            stream = Keystream.seeded("distance bench", size, m)
            templates = face_like_templates(count, m, size, stream=stream)
            probes: Probes = face_like(count, size, stream=stream)
            if mode == "s2s":
                probes = face_like_templates(count, m, size, stream=stream)
            times = time_in_turn(probes, templates, metric, repeats=repeats)
            rows.append({"n": size, "m": m, "mode": mode, "metric": metric, **times})
            advance(1)
    machine = {"processors": processors(), "device": device}
    return Result({"machine": machine, "count": count, "repeats": repeats, "rows": rows})


def time_in_turn(
    probes: Probes,
    templates: SubspaceBatch,
    metric: Metric,
    *,
    repeats: int,
) -> dict[str, float]:
    """Time product, distances and the authors' formula in turn; medians, and ratios in a repeat."""
    left, right = _stacked(probes), _stacked(templates)
    table = np.empty((len(left), len(right)), dtype=np.float32)
    some = slice(min(AUTHORS_COUNT, len(templates)))
    share = (len(templates) / some.stop) ** 2
    times = np.empty((repeats + 1, 3))
    for row in times:
        row[0] = _milliseconds(lambda: np.matmul(left, right.T, out=table))
        time.sleep(REST_S)
        row[1] = _milliseconds(lambda: pairwise_distances(probes, templates, metric=metric))
        row[2] = _milliseconds(lambda: authors_distances(probes[some], templates[some])) * share
    whole, ours, authors = times[1:].T  # the first round only fetches code and memory
    return {
        "product": statistics.median(whole),
        "distances": statistics.median(ours),
        "to_product": statistics.median(ours / whole),
        "low": float((ours / whole).min()),
        "high": float((ours / whole).max()),
        "authors": statistics.median(authors / ours),
    }


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
    rows = stream.normal((count, n)) / np.sqrt(1 + np.arange(n) / 8) + 0.3 * (np.arange(n) == 0)
    embeddings: Array32 = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return embeddings


def face_like_templates(count: int, m: int, n: int, *, stream: Keystream) -> SubspaceBatch:
    """Templates of such embeddings, each with m others as decoys of its own."""
    members = face_like(count * (m + 1), n, stream=stream).reshape(count, m + 1, n)
    return SubspaceBatch.through(members[:, 0], members[:, 1:] - members[:, :1], stream=stream)


def _milliseconds(task: Callable[[], object]) -> float:
    """Time a task; a short one at its second run, when its threads and memory are awake."""
    for _ in range(2):
        start = time.perf_counter_ns()
        task()
        taken = (time.perf_counter_ns() - start) / 1e6
        if taken > LONG_MS:
            break
    return taken


def _stacked(side: Probes) -> NDArray[np.floating]:
    """Rows whose products with those of another side are the Gram matrix."""
    if not isinstance(side, SubspaceBatch):
        return side
    return np.concatenate([side.feet[:, None], side.bases], axis=1).reshape(-1, side.n)
