"""The measurement of `veilface bench distances`: what it times, not how long that takes."""

from typing import Any

import numpy as np
import pytest

from api.cli import distance_bench
from api.cli.distance_bench import Question, Repeat, Row, face_like, face_like_templates, measure
from templates.distances import Metric
from templates.keys.randomness import Keystream
from verify.evaluation.units import Mode

TINY = Question(count=9, dimensions=(12,), dims=(2, 3), repeats=2)


@pytest.fixture(autouse=True)
def no_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here depends on what a time is."""
    monkeypatch.setattr(distance_bench, "_REST", 0)


class Products:
    """Records the matrix products that are made, and their results."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: list[tuple[int, int, int]] = []
        self._real = np.matmul
        monkeypatch.setattr(distance_bench.np, "matmul", self)

    def __call__(self, left: np.ndarray, right: np.ndarray, **options: Any) -> np.ndarray:
        if left.ndim == 2 and "out" in options:
            self.seen.append((len(left), right.shape[0], right.shape[1]))
        return self._real(left, right, **options)


@pytest.mark.parametrize("mode", [Mode.POINT, Mode.SUBSPACE])
@pytest.mark.parametrize("band_bytes", [1 << 30, 1000])
def test_the_bare_product_is_that_of_all_stacked_rows(
    mode: Mode, band_bytes: int, monkeypatch: pytest.MonkeyPatch
):
    count, n, m = 9, 12, 3
    stream = Keystream.seeded("bench")
    templates = face_like_templates(count, m, n, stream=stream)
    probes = (
        face_like(count, n, stream=stream)
        if mode is Mode.POINT
        else face_like_templates(count, m, n, stream=stream)
    )
    monkeypatch.setattr(distance_bench, "_BAND_BYTES", band_bytes)
    tasks = distance_bench._tasks(probes, templates, Question(count, (n,), (m,)))
    products = Products(monkeypatch)
    tasks.product()
    rows = count if mode is Mode.POINT else count * (m + 1)
    assert sum(left for left, *_ in products.seen) == rows
    assert {shape[1:] for shape in products.seen} == {(n, count * (m + 1))}
    assert (len(products.seen) > 1) == (4 * rows * count * (m + 1) > band_bytes)
    products.seen.clear()
    tasks.points()
    assert products.seen == [(count, n, count)]


@pytest.mark.parametrize("device", [None, "cpu"])
def test_every_combination_is_measured_in_turn(device: str | None):
    if device is not None:
        pytest.importorskip("torch")
    question = Question(count=9, dimensions=(12,), dims=(2, 3), repeats=2, device=device)
    steps: list[int] = []
    rows = measure(question, progress=steps.append)
    assert [(row.m, row.mode, row.metric) for row in rows] == [
        (m, mode, metric)
        for m in (2, 3)
        for mode in (Mode.POINT, Mode.SUBSPACE)
        for metric in Metric
    ]
    assert all(len(row.repeats) == 2 and min(map(min, row.repeats)) > 0 for row in rows)
    assert sum(steps) == question.rounds


def test_products_and_distances_alternate(monkeypatch: pytest.MonkeyPatch):
    order: list[str] = []
    tasks = distance_bench._Tasks(
        lambda: order.append("points"),
        lambda: order.append("product"),
        {metric: (lambda metric=metric: order.append(metric)) for metric in Metric},
    )
    seen = distance_bench._interleaved(tasks, TINY, lambda _: None)
    turn = ["points", "product", "euclidean", "points", "product", "spherical"]
    # A short task runs twice, and the second run counts; in the round that only warms, once.
    twice = [task for task in turn for _ in range(2)]
    assert order == [*twice[:5], *twice[6:11], *twice, *twice]
    assert {metric: len(repeats) for metric, repeats in seen.items()} == dict.fromkeys(Metric, 2)


def test_a_short_task_is_timed_at_its_second_run(monkeypatch: pytest.MonkeyPatch):
    clock = iter([0, 50_000_000, 100_000_000, 130_000_000, 0, 300_000_000])
    monkeypatch.setattr(distance_bench.time, "perf_counter_ns", lambda: next(clock))
    assert distance_bench._milliseconds(lambda: None) == 30
    assert distance_bench._milliseconds(lambda: None) == 300


def test_ratios_are_medians_of_ratios_inside_a_repeat():
    repeats = (Repeat(1, 2, 3), Repeat(2, 20, 22), Repeat(4, 5, 40))
    row = Row(128, 2, Mode.POINT, Metric.EUCLIDEAN, repeats)
    shown = row.to_json()
    assert row.medians == Repeat(2, 5, 22)
    assert shown["ratio_to_product"] == 1.5
    assert (shown["ratio_to_product_low"], shown["ratio_to_product_high"]) == (1.1, 8)
    assert shown["ratio_to_points"] == 10


def test_descriptors_are_spread_like_faces():
    rows = face_like(4000, 64, stream=Keystream.seeded("spread")).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-6)
    assert np.linalg.norm(rows.mean(axis=0)) > 0.05
    spectrum = np.linalg.eigvalsh(np.cov(rows.T))
    assert spectrum[-1] > 4 * spectrum[0]


def test_templates_hold_a_descriptor_of_their_own():
    stream, again = Keystream.seeded("held"), Keystream.seeded("held")
    batch = face_like_templates(5, 3, 12, stream=stream)
    members = face_like(20, 12, stream=again).reshape(5, 4, 12)
    assert all(
        batch[i].contains(member, tol=1e-5).all()
        for i in range(5)
        for member in members[i][:, None]
    )


def test_memory_grows_with_the_lifted_probes_only_up_to_a_band():
    def needed(count: int, *modes: Mode) -> int:
        return distance_bench.memory_needed(Question(count, (512,), (16,), modes=modes))

    assert needed(1000, Mode.POINT) < needed(1000, Mode.SUBSPACE) < 3 << 30
    assert needed(100_000, Mode.SUBSPACE) - needed(100_000, Mode.POINT) < 16 << 30
