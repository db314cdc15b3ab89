"""Similarities of all pairs of a set, raw or lifted."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.decoys import Attributes, DecoyPool, DecoySource
from templates.distances import Metric, paired_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify.evaluation.plan import EvaluationPlan, Json, Mode, Source, Unit, decoy_kind

_TILE = 8192
"""Subspace rows (pairs times m) that are lifted at once on either side."""


@dataclass(frozen=True, eq=False, repr=False)
class Trials:
    """The pairs of a set of which both sides have an embedding, and what they are lifted with."""

    name: str
    embeddings: NDArray[np.float32]  # (N, n) unit rows
    first: NDArray[np.int64]  # (P,) rows, as `second`
    second: NDArray[np.int64]
    same: NDArray[np.bool_]
    folds: NDArray[np.int64] | None  # None where the protocol has none
    people: NDArray[np.int64] | None  # (2, P), where the set names people
    attributes: Sequence[Attributes] | None  # one per row, for hybrid+
    sources: tuple[Source, ...]  # decoys, from which people of the set were removed
    kept: NDArray[np.int64]  # (P,) positions of the pairs in the set
    failed_genuine: int = 0  # pairs of the set that lack an embedding
    failed_impostor: int = 0
    fta: float = 0.0  # share of photos that gave none (ISO/IEC 19795-1)

    def __len__(self) -> int:
        return len(self.same)

    @property
    def genuine(self) -> int:
        """Number of pairs that show one person."""
        return int(np.count_nonzero(self.same))

    @property
    def impostor(self) -> int:
        """Number of pairs that show two people."""
        return len(self) - self.genuine


def compare(
    trials: Trials, unit: Unit, plan: EvaluationPlan
) -> list[tuple[Json, NDArray[np.float64]]]:
    """Compare all pairs, in every mode and metric of the plan: similarities (P,), 1 − d²/2.

    Each goes with its names: ``strategy``, ``decoys`` (pool, generator or None), ``shared_decoys``
    (None without a pool), ``dim``, ``mode``, ``metric``, ``seed`` and ``lifted``, which photo of
    each pair was lifted (first, second, both or None).
    """
    names: Json = {
        "strategy": unit.strategy,
        "decoys": None,
        "shared_decoys": None,
        "dim": unit.m,
    }
    if unit.raw:
        names |= {"mode": Mode.RAW.value, "metric": Metric.EUCLIDEAN.value}
        names |= {"seed": None, "lifted": None}
        return [(names, _cosines(trials.embeddings, trials.first, trials.second))]
    if unit.source is not None:
        names["decoys"] = decoy_kind(trials.sources[unit.source])
        names["shared_decoys"] = plan.shared_decoys if names["decoys"] == "pool" else None
    sides: list[tuple[Mode, str]] = []
    if Mode.POINT in plan.modes:
        # Neither photo of a pair is privileged, so each is lifted once.
        sides += [(Mode.POINT, "first"), (Mode.POINT, "second")]
    if Mode.SUBSPACE in plan.modes:
        sides.append((Mode.SUBSPACE, "both"))
    layout = [(mode, lifted, metric) for mode, lifted in sides for metric in plan.metrics]
    columns = [np.empty(len(trials)) for _ in layout]
    for rows_of_tile, points, batches in _lifted(trials, unit, plan):
        for (_, lifted, metric), column in zip(layout, columns, strict=True):
            probes: NDArray[np.float32] | SubspaceBatch
            match lifted:
                case "first":
                    probes, templates = points[1], batches[0]
                case "second":
                    probes, templates = points[0], batches[1]
                case _:
                    probes, templates = batches
            distances = paired_distances(probes, templates, metric=metric, steps=plan.steps)
            column[rows_of_tile] = similarity(distances.astype(np.float64))
    return [
        (
            names
            | {"mode": mode.value, "metric": metric.value, "seed": unit.seed, "lifted": lifted},
            column,
        )
        for (mode, lifted, metric), column in zip(layout, columns, strict=True)
    ]


def _cosines(
    rows: NDArray[np.float32], first: NDArray[np.int64], second: NDArray[np.int64]
) -> NDArray[np.float64]:
    unit = rows.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    gaps = unit[first] - unit[second]
    # Through the distance, as the literature's code has it, and not through the product.
    return np.asarray(1 - np.einsum("ij,ij->i", gaps, gaps) / 2)


_Points = tuple[NDArray[np.float32], NDArray[np.float32]]
_Batches = tuple[SubspaceBatch, SubspaceBatch]


def _lifted(
    trials: Trials, unit: Unit, plan: EvaluationPlan
) -> Iterator[tuple[slice, _Points, _Batches]]:
    """Lift both sides of the pairs, a tile at a time."""
    decoys = _sides(trials, unit, plan)
    streams = [
        Keystream.seeded("evaluation", side, unit.strategy, unit.m, unit.seed or 0)
        for side in ("first", "second")
    ]
    step = max(1, _TILE // unit.m)
    for start in range(0, len(trials), step):
        rows = slice(start, min(start + step, len(trials)))
        points, batches = [], []
        for photos, source, stream in zip(
            (trials.first[rows], trials.second[rows]), decoys, streams, strict=True
        ):
            embeddings = trials.embeddings[photos]
            points.append(embeddings if source is None else source.project(embeddings))
            batches.append(
                lift(
                    points[-1],
                    strategy=unit.strategy,
                    m=unit.m,
                    source=source,
                    stream=stream,
                    attributes=_attributes(trials, unit, photos),
                )
            )
        yield rows, (points[0], points[1]), (batches[0], batches[1])


def _sides(
    trials: Trials, unit: Unit, plan: EvaluationPlan
) -> tuple[DecoySource | None, DecoySource | None]:
    """Decoys of the two sides: of a pool its halves, unless they are to share it."""
    if unit.source is None:
        return None, None
    source = trials.sources[unit.source]
    if plan.shared_decoys or not isinstance(source, DecoyPool):
        return source, source
    return split_pool(source, seed=unit.seed or 0)


def split_pool(pool: DecoyPool, *, seed: int) -> tuple[DecoyPool, DecoyPool]:
    """Split a pool at random, half for enrollment, half for probes (docs/method.md §4.4)."""
    stream = Keystream.seeded("evaluation", "halves", pool.source_id, seed)
    order = stream.choose(len(pool), 1, len(pool))[0]
    half = len(pool) // 2
    return pool.subset(np.sort(order[:half])), pool.subset(np.sort(order[half:]))


def _attributes(trials: Trials, unit: Unit, photos: NDArray[np.int64]) -> list[Attributes] | None:
    if unit.strategy != Strategy.HYBRID_PLUS:
        return None
    if trials.attributes is None:
        raise ValueError("hybrid+ needs the attributes of the photos")
    return [trials.attributes[photo] for photo in photos.tolist()]
