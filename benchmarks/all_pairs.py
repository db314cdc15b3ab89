"""All pairs of photos of different people: the time, the memory, and the false match rates.

Every photo is lifted (adversarial, generated decoys), and every embedding is compared with every
template. A photo's decoys come from a generator that was fitted to the other half of the people,
or from the file of ``--decoys``. Nothing but the counts of pairs up to each threshold is kept.

Memory is the largest resident size of the process before the count and after it. It includes the
interpreter, the libraries, the embeddings and the templates, and after the count also all that
the count needs. Where the system lets a process reset it (Linux), lifting is not in it.

Thresholds are 40 similarities from the one that 15 % of a sample of the pairs reach, upwards. At
the lowest rates, people who have photos under two names decide: look at the pairs before believing
a threshold there.

Example
-------
::

    python -m benchmarks.all_pairs ../shared/data/lfw/aligned112 --pack PACK --dim 16
"""

import argparse
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.extraction import Extractor
from models.pack import ModelPack
from templates.decoys import DecoyGenerator
from templates.distances import Metric, count_within, pairwise_distances, similarity, warm_up
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify import labelled_folder

_THRESHOLDS = 40
_SPAN = 0.3
_SAMPLE = 1000
TARGETS = tuple(10.0**-digits for digits in range(1, 7))
_CHUNK = 256


class People(NamedTuple):
    """Embeddings of photos, and whose they are."""

    descriptors: NDArray[np.float32]
    labels: NDArray[np.int64]


def read(source: Path, pack: Path | None) -> People:
    """Read an ``.npz`` with ``descriptors`` and ``names``, or embed a folder of aligned crops."""
    if pack is None:
        with np.load(source) as file:
            descriptors, names = file["descriptors"], file["names"]
    else:
        folder = labelled_folder(source)
        name_of = dict(zip(folder.paths, folder.identities, strict=True))
        extraction = Extractor(ModelPack.load(pack), aligned=True).extract(folder.paths)
        descriptors, names = (
            extraction.descriptors,
            np.array([name_of[path] for path in extraction.paths]),
        )
    labels = np.unique(names, return_inverse=True)[1]
    return People(np.ascontiguousarray(descriptors, dtype=np.float32), labels.astype(np.int64))


def lifted(people: People, m: int, decoys: Path | None) -> SubspaceBatch:
    """A template of every photo, a few at a time."""
    if decoys is not None:
        generator = DecoyGenerator.load(decoys)
        halves = [(np.ones(len(people.labels), dtype=bool), generator)]
    else:
        odd = people.labels % 2 == 1
        halves = [(half, DecoyGenerator.fit(people.descriptors[~half])) for half in (odd, ~odd)]
    count, n = people.descriptors.shape
    feet = np.empty((count, n), dtype=np.float32)
    bases = np.empty((count, m, n), dtype=np.float32)
    for half, generator in halves:
        rows = np.flatnonzero(half)
        for some in _chunks(rows):
            batch = lift(
                people.descriptors[some], strategy=Strategy.ADVERSARIAL, m=m, source=generator
            )
            feet[some], bases[some] = batch.feet, batch.bases
    return SubspaceBatch(feet, bases)


def _chunks(rows: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    return (rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK))


def thresholds(people: People, templates: SubspaceBatch, metric: Metric) -> NDArray[np.float64]:
    """Similarities that ascend from the 85 % quantile of a sample of the pairs."""
    every = max(1, len(people.labels) // _SAMPLE)
    some = SubspaceBatch(templates.feet[::every], templates.bases[::every])
    similarities = similarity(pairwise_distances(people.descriptors[::every], some, metric=metric))
    different = people.labels[::every, None] != people.labels[None, ::every]
    low = float(np.quantile(similarities[different], 0.85))
    return low + np.linspace(0, _SPAN, _THRESHOLDS)


def peak_bytes() -> int:
    """Largest resident memory of the process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def reset_peak() -> None:
    """Let the peak begin at what is resident now, where the system allows it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def impostor_pairs(labels: NDArray[np.int64]) -> int:
    """Ordered pairs of photos of different people."""
    sizes = np.bincount(labels)
    return int(len(labels) ** 2 - (sizes**2).sum())


def table(similarities: NDArray[np.float64], counts: NDArray[np.int64], pairs: int) -> str:
    """The lowest threshold of the row that meets each target, in Markdown."""
    lines = ["| target FMR | similarity threshold | pairs up to it | FMR |", "|---|---|---|---|"]
    for target in TARGETS:
        met = np.flatnonzero(counts <= target * pairs)
        if not met.size:
            lines.append(f"| {target:.0e} | above {similarities[-1]:.3f} | | |")
            continue
        at = met[0]
        lines.append(
            f"| {target:.0e} | {similarities[at]:.3f} | {counts[at]:,} | {counts[at] / pairs:.2g} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Read, lift, count, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="folder of aligned crops, or .npz")
    parser.add_argument("--pack", type=Path, help="model pack, where the source is a folder")
    parser.add_argument("--decoys", type=Path, help="generator of `veilface decoys build`")
    parser.add_argument("--dim", type=int, default=16)
    parser.add_argument("--metric", type=Metric, choices=list(Metric), default=Metric.SPHERICAL)
    parser.add_argument("--threads", type=int)
    given = parser.parse_args()
    if given.source.is_dir() != (given.pack is not None):
        parser.error("a folder needs --pack, and an .npz has embeddings already")
    people = read(given.source, given.pack)
    templates = lifted(people, given.dim, given.decoys)
    count, n = people.descriptors.shape
    warm_up()
    similarities = thresholds(people, templates, given.metric)
    reset_peak()
    before = peak_bytes()
    start = time.perf_counter()
    counts = count_within(
        people.descriptors,
        templates,
        np.sqrt(2 - 2 * similarities),
        metric=given.metric,
        labels=(people.labels, people.labels),
        threads=given.threads,
    )
    seconds = time.perf_counter() - start
    after = peak_bytes()
    pairs = impostor_pairs(people.labels)
    resident = (people.descriptors.nbytes + templates.feet.nbytes + templates.bases.nbytes) / 2**20
    whole = 4 * count**2 / 2**20
    print(
        f"{count} photos of {len(np.unique(people.labels))} people, n = {n}, m = {given.dim}, "
        f"{given.metric}, point to subspace, {len(similarities)} thresholds\n"
        f"{pairs:,} pairs of different people: {seconds:.1f} s, {seconds / count**2 * 1e9:.0f} ns "
        f"for each of the {count**2:,} pairs\n"
        f"peak memory {before / 2**20:.0f} MiB before the count ({resident:.0f} of them embeddings "
        f"and templates), {after / 2**20:.0f} after it; the matrix of distances would take "
        f"{whole:.0f}\n"
    )
    print(table(similarities, counts, pairs))


if __name__ == "__main__":
    main()
