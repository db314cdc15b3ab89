r"""Whether the spherical subspace-to-subspace distance is the smallest, on pairs of impostors.

Each similarity of the float32 kernel is compared with the best that 64 random restarts of the
accelerated alternation find in float64, and with the similarity of the hidden descriptors.

Example
-------
::

    python -m benchmarks.spherical_optimum descriptors.npz --pairs 10000

The file holds ``descriptors`` (N, n), unit rows, and ``names`` (N,).
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.distances import DEFAULT_STEPS, Metric, exact, paired_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch

_RESTARTS = 64
_STEPS = 500
_CHUNK = 250


def main(arguments: list[str]) -> int:
    """Print one row for every dimension."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("descriptors", type=Path)
    parser.add_argument("--pairs", type=int, default=10_000)
    parser.add_argument("--dim", default="2,4,8,16")
    parser.add_argument("--decoys", choices=["generator", "pool"], default="generator")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    with np.load(chosen.descriptors) as content:
        descriptors, names = content["descriptors"], content["names"]
    left, right, source = impostors(descriptors, names, chosen.pairs, chosen.decoys, chosen.seed)
    print(f"{len(left)} pairs of different people, n = {left.shape[1]}, {chosen.decoys} decoys")
    print(f"{DEFAULT_STEPS} steps; restarts: {_RESTARTS} of up to {_STEPS} steps in float64")
    for m in map(int, chosen.dim.split(",")):
        print(row(left, right, source, m, chosen.seed), flush=True)
    return 0


def impostors(
    descriptors: NDArray[np.float32], names: NDArray[np.str_], pairs: int, decoys: str, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], DecoySource]:
    """Pairs of people of one half, and decoys of the other half's people."""
    rng = np.random.default_rng(seed)
    people = rng.permutation(np.unique(names))
    others = np.isin(names, people[: len(people) // 2])
    source = DecoyPool(descriptors[others])
    rows, who = descriptors[~others], names[~others]
    first, second = rng.integers(len(rows), size=(2, 2 * pairs))
    kept = np.flatnonzero(who[first] != who[second])[:pairs]
    fitted = DecoyGenerator.fit(descriptors[others]) if decoys == "generator" else source
    return rows[first[kept]], rows[second[kept]], fitted


def row(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    source: DecoySource,
    m: int,
    seed: int,
) -> str:
    """Compare at one dimension."""
    a, b = (
        lift(
            side,
            strategy="adversarial",
            m=m,
            source=source,
            stream=Keystream.seeded("optimum", m, number, seed),
        )
        for number, side in enumerate((left, right))
    )
    start = time.perf_counter()
    seen = similarity(paired_distances(a, b, metric=Metric.SPHERICAL).astype(np.float64))
    taken = time.perf_counter() - start
    missing = best_of_restarts(a, b, seed) - seen
    below = np.einsum("ij,ij->i", left, right, dtype=np.float64) - seen
    return (
        f"m = {m}: within 1e-3 of the best in {100 * np.mean(missing <= 1e-3):.2f} %, "
        f"1e-5 in {100 * np.mean(missing <= 1e-5):.2f} %; largest lack {missing.max():.1e}; "
        f"better than all restarts by 1e-5 in {100 * np.mean(missing < -1e-5):.2f} %; "
        f"hidden descriptors nearer by at most {below.max():.1e}; "
        f"{taken / len(left) * 1e6:.1f} µs a pair, products of single pairs included"
    )


def best_of_restarts(a: SubspaceBatch, b: SubspaceBatch, seed: int) -> NDArray[np.float64]:
    """Best similarity of probe i and template i over random restarts, (P,)."""
    out = np.empty(len(a))
    rng = np.random.default_rng(seed)
    for start in range(0, len(a), _CHUNK):
        part = slice(start, start + _CHUNK)
        dots, *fields = exact.problem_of(exact.Rows.of(a, part), exact.Rows.of(b, part))
        starts = rng.normal(size=(len(dots), _RESTARTS, b.m))
        starts /= np.linalg.norm(starts, axis=2, keepdims=True)
        _, gains = exact.maximise(exact.Problem(*fields), starts, _STEPS)
        out[part] = dots + gains
    return out


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
