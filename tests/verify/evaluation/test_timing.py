from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from templates.distances import Metric, pairwise_distances
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.verify.evaluation.materials import N, material
from verify.evaluation import timing
from verify.evaluation.timing import timings
from verify.evaluation.units import Cell, Mode

SPHERICAL = Metric.SPHERICAL.value
RAW = Cell("raw", None, None, 0, Mode.RAW, Metric.EUCLIDEAN.value)
FLIP = Cell("raw+flip", None, None, 0, Mode.RAW, Metric.EUCLIDEAN.value)
POINT = Cell("random", None, None, 2, Mode.POINT, SPHERICAL)
SPACE = Cell("adversarial", "pool", False, 4, Mode.SUBSPACE, Metric.EUCLIDEAN.value)
BALANCED = Cell("hybrid+", "pool", True, 2, Mode.SUBSPACE, SPHERICAL)
CELLS = [
    (RAW, None),
    (FLIP, None),
    (POINT, None),
    (SPACE, 0),
    (BALANCED, 0),
]


def test_every_cell_has_one_entry_that_names_it() -> None:
    found = timings(material(), CELLS)
    for (cell, _), entry in zip(CELLS, found, strict=True):
        assert entry == {
            "strategy": cell.strategy,
            "decoys": cell.decoys,
            "shared_decoys": cell.shared_decoys,
            "dim": cell.dim,
            "mode": cell.mode.value,
            "metric": cell.metric,
            "n": N,
            "microseconds_per_comparison": entry["microseconds_per_comparison"],
            "ratio_to_raw": entry["ratio_to_raw"],
        }
        assert type(entry["microseconds_per_comparison"]) is float
        assert entry["microseconds_per_comparison"] > 0
    assert timings(material(), []) == []


def test_the_ratio_is_over_raw_of_the_same_run() -> None:
    found = timings(material(), CELLS)
    raw = found[0]["microseconds_per_comparison"]
    assert found[0]["ratio_to_raw"] == found[1]["ratio_to_raw"] == 1
    for entry in found:
        assert entry["ratio_to_raw"] == pytest.approx(entry["microseconds_per_comparison"] / raw)


def test_few_photos_suffice() -> None:
    """Fewer than the 192 rows of a timed product: they are taken again."""
    (entry,) = timings(material(people=2, pairs=10), [(SPACE, 0)])
    assert entry["microseconds_per_comparison"] > 0


def test_what_is_timed_is_the_comparison_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """96 probes with 96 templates of the cell's dimension; lifting is not in the time."""
    seen: list[tuple[int, tuple[int, ...], str]] = []
    lifted: list[int] = []

    def counted(
        side: NDArray[np.float32] | SubspaceBatch, templates: SubspaceBatch, *, metric: str
    ) -> object:
        probes = side.bases if isinstance(side, SubspaceBatch) else side
        seen.append((templates.m, probes.shape, metric))
        return pairwise_distances(side, templates, metric=metric)

    def counted_lift(*given: object, **named: object) -> object:
        lifted.append(1)
        return lift(*given, **named)  # type: ignore[arg-type]

    def timed(call: Callable[[], object]) -> float:
        before = len(lifted)
        call()
        assert len(lifted) == before
        return 1.0

    monkeypatch.setattr(timing, "pairwise_distances", counted)
    monkeypatch.setattr(timing, "lift", counted_lift)
    monkeypatch.setattr(timing, "_median", timed)
    timings(material(), [(POINT, None), (SPACE, 0)])
    assert seen == [(2, (96, N), "spherical"), (4, (96, 4, N), "euclidean")]
