"""What one comparison costs: measured in the run, on its own templates, as a ratio to raw."""

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from templates.distances import pairwise_distances
from templates.distances.blas import single_threaded
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from verify.evaluation.material import Material
from verify.evaluation.rows import Json, cell_json
from verify.evaluation.units import Cell, Mode

_SIDE = 96
_REPEATS = 5


def timings(material: Material, cells: Sequence[tuple[Cell, int | None]]) -> list[Json]:
    """Time bulk comparisons of every cell, on one thread.

    Returns
    -------
    list of dict
        ``microseconds_per_comparison``: the median of five products of 96 probes with 96
        templates, per pair; ``ratio_to_raw``: over that of raw descriptors in the same run.
    """
    rows = material.descriptors[np.arange(2 * _SIDE) % len(material.descriptors)]
    probes, others = rows[:_SIDE], rows[_SIDE:]
    with single_threaded():
        raw = _median(lambda: probes @ others.T)
        measured = []
        for cell, source in cells:
            micro = raw if cell.mode is Mode.RAW else _of(material, cell, source, probes, others)
            measured.append(
                {
                    **cell_json(cell),
                    "n": material.n,
                    "microseconds_per_comparison": micro,
                    "ratio_to_raw": micro / raw,
                }
            )
    return measured


def _of(
    material: Material,
    cell: Cell,
    source: int | None,
    probes: NDArray[np.float32],
    others: NDArray[np.float32],
) -> float:
    attributes = None
    if cell.strategy == Strategy.HYBRID_PLUS and material.attributes is not None:
        attributes = [material.attributes[i % len(material.attributes)] for i in range(_SIDE)]
    with Keystream.seeded("evaluation", "timing", cell.strategy, cell.dim) as stream:
        lifted = [
            lift(
                side,
                strategy=cell.strategy,
                m=cell.dim,
                source=None if source is None else material.sources[source],
                stream=stream,
                attributes=attributes,
            )
            for side in (others, probes)
        ]
    side = lifted[1] if cell.mode is Mode.SUBSPACE else probes
    return _median(lambda: pairwise_distances(side, lifted[0], metric=cell.metric))


def _median(call: Callable[[], object]) -> float:
    """Microseconds per pair."""
    call()
    taken = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken)) / _SIDE**2 * 1e6
