"""Similarities of all pairs of a set in one unit of the evaluation."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.decoys import Attributes, DecoyPool, DecoySource
from templates.distances import Metric, on_device, paired_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify.evaluation.material import Material, Source
from verify.evaluation.units import (
    RAW,
    RAW_FLIP,
    Cell,
    DecoyKind,
    Lifted,
    LiftUnit,
    Mode,
    RawUnit,
    Unit,
)

_TILE = 8192
"""Subspace rows (pairs times m) that are lifted at once on either side."""


@dataclass(frozen=True, eq=False, repr=False)
class Scores:
    """Similarities of the pairs in one cell, for one seed and one lifted side.

    Parameters
    ----------
    lifted
        Which photo of each pair was lifted; None for raw descriptors.
    similarities : (P,) float64
        1 − d²/2.
    """

    cell: Cell
    lifted: Lifted | None
    similarities: NDArray[np.float64]


def unit_layout(unit: Unit, sources: tuple[Source, ...]) -> list[tuple[Cell, Lifted | None]]:
    """Cells and sides that a unit scores, in the order of :func:`score_unit`."""
    match unit:
        case RawUnit():
            name = RAW_FLIP if unit.flip else RAW
            return [(Cell(name, None, None, 0, Mode.RAW, Metric.EUCLIDEAN.value), None)]
    kind = None if unit.source is None else decoy_kind(sources[unit.source])
    sides: list[tuple[Mode, Lifted]] = []
    if Mode.POINT in unit.modes:
        # Neither photo of a pair is privileged, so each is lifted once.
        sides += [(Mode.POINT, "first"), (Mode.POINT, "second")]
    if Mode.SUBSPACE in unit.modes:
        sides.append((Mode.SUBSPACE, "both"))
    shared = unit.shared if kind == "pool" else None
    layout: list[tuple[Cell, Lifted | None]] = []
    for mode, lifted in sides:
        for metric in unit.metrics:
            cell = Cell(unit.strategy.value, kind, shared, unit.m, mode, metric.value)
            layout.append((cell, lifted))
    return layout


def score_unit(material: Material, unit: Unit) -> list[Scores]:
    """Compare all pairs.

    Raises
    ------
    LiftingError, DecoyError
        The decoys do not suffice for the strategy.
    """
    layout = unit_layout(unit, material.sources)
    match unit:
        case RawUnit():
            rows = material.flipped if unit.flip else material.descriptors
            if rows is None:
                raise ValueError("embeddings with the mirror image were not acquired")
            columns = [_cosines(rows, material.first, material.second)]
        case LiftUnit():
            columns = _lifted(material, unit, layout)
    return [
        Scores(cell, lifted, column) for (cell, lifted), column in zip(layout, columns, strict=True)
    ]


def decoy_kind(source: Source) -> DecoyKind:
    """Name the kind of a source, as rows do."""
    return "pool" if isinstance(source, DecoyPool) else "generator"


def _cosines(
    rows: NDArray[np.float32], first: NDArray[np.int64], second: NDArray[np.int64]
) -> NDArray[np.float64]:
    unit = rows.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    gaps = unit[first] - unit[second]
    # Through the distance, as the literature's code has it, and not through the product.
    return np.asarray(1 - np.einsum("ij,ij->i", gaps, gaps) / 2)


def _lifted(
    material: Material, unit: LiftUnit, layout: list[tuple[Cell, Lifted | None]]
) -> list[NDArray[np.float64]]:
    columns = [np.empty(len(material)) for _ in layout]
    decoys = _sides(material, unit)
    with (
        Keystream.seeded("evaluation", "first", unit.strategy, unit.m, unit.seed) as one,
        Keystream.seeded("evaluation", "second", unit.strategy, unit.m, unit.seed) as two,
    ):
        for rows in _tiles(len(material), unit.m):
            photos = material.first[rows], material.second[rows]
            points = tuple(
                material.descriptors[photo]
                if source is None
                else source.project(material.descriptors[photo])
                for photo, source in zip(photos, decoys, strict=True)
            )
            batches = tuple(
                lift(
                    points[side],
                    strategy=unit.strategy,
                    m=unit.m,
                    source=decoys[side],
                    stream=stream,
                    attributes=_attributes(material, unit, photos[side]),
                )
                for side, stream in enumerate((one, two))
            )
            for column, (cell, lifted) in zip(columns, layout, strict=True):
                probes: NDArray[np.float32] | SubspaceBatch
                match lifted:
                    case "first":
                        probes, templates = points[1], batches[0]
                    case "second":
                        probes, templates = points[0], batches[1]
                    case _:
                        probes, templates = batches[0], batches[1]
                with on_device(unit.device):
                    distances = paired_distances(
                        probes, templates, metric=cell.metric, steps=unit.steps
                    )
                column[rows] = similarity(distances.astype(np.float64))
    return columns


def _sides(material: Material, unit: LiftUnit) -> tuple[DecoySource | None, DecoySource | None]:
    """Decoys of the two sides: of a pool its halves, unless they are to share it."""
    if unit.source is None:
        return None, None
    source = material.sources[unit.source]
    if unit.shared or not isinstance(source, DecoyPool):
        return source, source
    return split_pool(source, seed=unit.seed)


def split_pool(pool: DecoyPool, *, seed: int) -> tuple[DecoyPool, DecoyPool]:
    """Split a pool at random, half for enrollment, half for probes (docs/method.md §4.4)."""
    with Keystream.seeded("evaluation", "halves", pool.source_id, seed) as stream:
        order = stream.choose(len(pool), 1, len(pool))[0]
    half = len(pool) // 2
    return pool.subset(np.sort(order[:half])), pool.subset(np.sort(order[half:]))


def _attributes(
    material: Material, unit: LiftUnit, photos: NDArray[np.int64]
) -> list[Attributes] | None:
    if unit.strategy is not Strategy.HYBRID_PLUS:
        return None
    if material.attributes is None:
        raise ValueError("hybrid+ needs the attributes of the photos")
    return [material.attributes[photo] for photo in photos.tolist()]


def _tiles(pairs: int, m: int) -> Iterator[slice]:
    step = max(1, _TILE // m)
    return (slice(start, min(start + step, pairs)) for start in range(0, pairs, step))
