"""The compiled float32 kernels: what they agree with, and what does not change their result."""

import os
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import numba.core.caching as caching
import numpy as np
import pytest
import threadpoolctl
from hypothesis import given, settings
from hypothesis import strategies as st

from templates.decoys import DecoyPool
from templates.distances import (
    Metric,
    count_within,
    exact,
    nearest,
    paired_distances,
    pairwise_distances,
    similarity,
    tiles,
    warm_up,
)
from templates.distances.kernels import lanes
from templates.errors import InvalidEmbedding, TemplateError
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.patience import PATIENCE_S

METRICS = list(Metric)
# How far apart distances may be that were computed on other numbers of threads (docs/distances.md).
THREADS_ATOL = 2e-6
SHAPES = [(1, 1), (1, 9), (2, 2), (2, 16), (3, 4), (7, 5), (16, 16), (20, 33), (64, 64)]


def units(count: int, n: int, *seed: object) -> np.ndarray:
    rows = Keystream.seeded("units", n, *seed).normal((count, n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def faces(count: int, n: int, *seed: object) -> np.ndarray:
    """Unit rows that are spread like faces: a mean, a steep spectrum."""
    scales = 1 / np.sqrt(1 + np.arange(n) / 8)
    rows = Keystream.seeded("faces", n, *seed).normal((count, n)) * scales
    rows += 0.3 * (np.arange(n) == 0)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def lifted(points: np.ndarray, m: int, *seed: object, decoys: np.ndarray | None = None):
    """Adversarial lifts of points with decoys of their kind."""
    if decoys is None:
        decoys = faces(40 * m, points.shape[1], "decoys", *seed)
    stream = Keystream.seeded("lifted", *seed)
    return lift(points, strategy="adversarial", m=m, source=DecoyPool(decoys), stream=stream)


def least_squares(a: SubspaceBatch, b: SubspaceBatch) -> np.ndarray:
    """Euclidean distances by singular values in float64, pair by pair (paper eq. 5).

    Directions that differ by less than the rounding of float32 storage are one.
    """
    out = np.empty((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            gap = b.feet[j].astype(np.float64) - a.feet[i]
            rows = np.vstack([a.bases[i], b.bases[j]]).astype(np.float64)
            solution = np.linalg.lstsq(rows.T, gap, rcond=1e-6)[0]
            out[i, j] = np.linalg.norm(gap - rows.T @ solution)
    return out


def relations(n: int, m: int, k: int) -> dict[str, tuple[SubspaceBatch, SubspaceBatch]]:
    """Pairs of batches in the relations that strain a solver."""
    x, y = units(6, n, "x"), units(7, n, "y")
    stream = Keystream.seeded("relations", n, m, k)
    axes = np.linalg.qr(stream.normal((n, n)))[0].T
    decoys = faces(max(m, k) + 3, n, "few")
    plane = axes[: max(m, k)]
    tilt = plane + 2e-3 * units(len(plane), n, "tilt")

    def of(foot: np.ndarray, basis: np.ndarray) -> SubspaceBatch:
        return SubspaceBatch.through(foot[None], np.asarray(basis)[None], stream=stream)

    found = {
        "random": (
            lift(x, strategy="random", m=m, stream=stream),
            lift(y, strategy="random", m=k, stream=stream),
        ),
        "shared decoys": (
            lifted(x, m, "shared", decoys=decoys),
            lifted(y, k, "shared too", decoys=decoys),
        ),
        "nearly parallel": (of(0.4 * axes[-1], plane[:m]), of(0.5 * axes[-2], tilt[:k])),
        "parallel": (of(0.4 * axes[-1], plane[:m]), of(0.5 * axes[-2], plane[:k])),
        "close": (of(0.4 * axes[-1], plane[:m]), of(0.41 * axes[-1], tilt[:k])),
    }
    same = lift(x, strategy="random", m=m, stream=stream)
    found["identical"] = (same, SubspaceBatch(same.feet, same.bases[:, ::-1]))
    if m + k + 2 <= n:
        found["orthogonal"] = (of(0.4 * axes[-1], axes[:m]), of(0.5 * axes[-2], axes[m : m + k]))
    return found


@pytest.mark.parametrize("shape", [*SHAPES[:-1], pytest.param(SHAPES[-1], marks=pytest.mark.long)])
@pytest.mark.parametrize("n", [64, 200, 512])
def test_euclidean_agrees_with_least_squares(n: int, shape: tuple[int, int]) -> None:
    if max(shape) + 2 > n:
        pytest.skip("no such subspaces")
    for name, (a, b) in relations(n, *shape).items():
        seen = pairwise_distances(a, b, metric="euclidean")
        expected = least_squares(a, b)
        assert seen.dtype == np.float32
        assert (seen >= 0).all(), name
        # A set that meets the other is at rounding error, of storage too, from it.
        np.testing.assert_allclose(seen, expected, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [64, 512])
def test_spherical_agrees_with_the_reference(n: int, shape: tuple[int, int]) -> None:
    if max(shape) + 2 > n:
        pytest.skip("no such subspaces")
    for name, (a, b) in relations(n, *shape).items():
        seen = pairwise_distances(a, b, metric="spherical")
        expected = pairwise_distances(a, b, metric="spherical", steps=400, dtype=np.float64)
        assert (seen >= 0).all(), name
        # Never better than the truth; the reference is below it now and then.
        above = (seen**2 - expected**2) / 2
        assert above.max() < 2e-5, name
        assert np.quantile(-above, 0.9) < 1e-5, name


def test_a_large_dimension() -> None:
    a, b = lifted(faces(3, 4096), 4, 1), lifted(faces(20, 4096, 2), 3, 2)
    points = faces(5, 4096, 3).astype(np.float32)
    for metric in METRICS:
        for probes in (a, points):
            np.testing.assert_allclose(
                pairwise_distances(probes, b, metric=metric),
                pairwise_distances(probes, b, metric=metric, dtype=np.float64),
                rtol=1e-5,
            )


def restarted(a: SubspaceBatch, b: SubspaceBatch, restarts: int, steps: int) -> np.ndarray:
    """Best similarity of probe i and template i over random restarts of plain alternation."""
    (scale, s), (other_scale, t) = exact.spheres(a.feet), exact.spheres(b.feet)
    p, q = a.feet * scale[:, None], b.feet * other_scale[:, None]
    d, e = a.bases * s[:, None, None], b.bases * t[:, None, None]
    g, h = (d @ q[:, :, None])[:, :, 0], (e @ p[:, :, None])[:, :, 0]
    middle = d @ e.transpose(0, 2, 1)
    v = Keystream.seeded("restarts").normal((len(a), restarts, b.m))
    for _ in range(steps):
        u = g[:, None] + v @ middle.transpose(0, 2, 1)
        u /= np.linalg.norm(u, axis=2, keepdims=True)
        v = h[:, None] + u @ middle
        length = np.linalg.norm(v, axis=2, keepdims=True)
        v /= length
    values = (u @ g[:, :, None])[:, :, 0] + length[:, :, 0]
    return np.einsum("ij,ij->i", p, q) + values.max(axis=1)


@pytest.mark.parametrize(
    "m", [1, 2, 8, *(pytest.param(each, marks=pytest.mark.long) for each in (3, 4, 16))]
)
def test_spherical_reaches_the_best_of_many_restarts(m: int) -> None:
    """On pairs of impostors that are spread like faces; with real ones: benchmarks."""
    x, y = faces(600, 128, "x"), faces(600, 128, "y")
    pool = faces(400, 128, "decoys")
    a, b = lifted(x, m, "a", decoys=pool[:200]), lifted(y, m, "b", decoys=pool[200:])
    seen = similarity(paired_distances(a, b, metric="spherical").astype(np.float64))
    best = restarted(a, b, 64, 400)
    assert (best - seen).max() < 1e-2
    assert np.quantile(best - seen, 0.99) < 1e-3
    assert (seen - best).max() < 1e-2  # restarts fall short too, but not by more
    hidden = np.einsum("ij,ij->i", x, y)
    assert (seen - hidden).min() > -1e-3
    assert (seen - hidden).max() > 0.01


# --- what does not change a distance -----------------------------------------------------------


@pytest.mark.parametrize("metric", METRICS)
def test_any_number_of_threads_gives_the_same_distances(
    metric: Metric, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiles, "_TILE_SIDE", 96)
    monkeypatch.setattr(tiles, "_LEAST", 1)
    a, b = lifted(faces(70, 64), 5, 1), lifted(faces(90, 64, 2), 3, 2)
    for probes in (a, faces(70, 64).astype(np.float32)):
        alone, *others = (
            pairwise_distances(probes, b, metric=metric, threads=threads) for threads in (1, 2, 5)
        )
        for other in others:
            np.testing.assert_allclose(other, alone, rtol=0, atol=THREADS_ATOL)
        one, two = (nearest(probes, b, k=7, metric=metric, threads=t) for t in (1, 3))
        np.testing.assert_allclose(one.distances, two.distances, rtol=0, atol=THREADS_ATOL)
        for neighbours in (one, two):
            np.testing.assert_allclose(
                np.take_along_axis(alone, neighbours.indices, axis=1),
                np.sort(alone, axis=1)[:, :7],
                rtol=0,
                atol=THREADS_ATOL,
            )


@pytest.mark.parametrize("metric", METRICS)
def test_a_distance_does_not_depend_on_the_pairs_beside_it(metric: Metric) -> None:
    a, b = lifted(faces(33, 64), 6, 1), lifted(faces(50, 64, 2), 6, 2)
    whole = pairwise_distances(a, b, metric=metric)
    paired = paired_distances(a, b[:33], metric=metric)
    np.testing.assert_allclose(paired, np.diagonal(whole), rtol=0, atol=2e-6)
    for i, j in ((0, 0), (7, 31), (32, 49)):
        alone = pairwise_distances(a[i : i + 1], b[j : j + 1], metric=metric)[0, 0]
        assert alone == pytest.approx(whole[i, j], abs=2e-6)


def test_callers_in_several_threads_get_what_one_gets_and_leave_the_library_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tiles, "_LEAST", 1)
    a, b = lifted(faces(40, 64), 4, 1), lifted(faces(300, 64, 2), 4, 2)
    expected = pairwise_distances(a, b, metric="spherical")
    seen: list[np.ndarray] = []

    def call() -> None:
        for _ in range(5):
            seen.append(pairwise_distances(a, b, metric="spherical"))

    # `make test` gives each of its processes one thread, and a call uses as many as there are.
    with threadpoolctl.threadpool_limits(3, user_api="blas"):
        before = [library["num_threads"] for library in threadpoolctl.threadpool_info()]
        assert 3 in before
        callers = [threading.Thread(target=call) for _ in range(6)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
        assert [library["num_threads"] for library in threadpoolctl.threadpool_info()] == before
    assert len(seen) == 30
    for distances in seen:
        np.testing.assert_allclose(distances, expected, rtol=0, atol=THREADS_ATOL)


def test_a_failure_in_one_thread_ends_the_traversal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "_TILE_SIDE", 64)
    monkeypatch.setattr(tiles, "_LEAST", 1)
    templates = lifted(faces(200, 64), 3, 1)
    calls: list[int] = []

    def progress(count: int) -> None:
        calls.append(count)
        raise InterruptedError

    before = threadpoolctl.threadpool_info()
    with pytest.raises(InterruptedError):
        nearest(templates, templates, k=1, metric="euclidean", threads=2, progress=progress)
    assert 1 <= len(calls) <= 2
    assert threadpoolctl.threadpool_info() == before


# --- what is kept of the matrix ----------------------------------------------------------------


@settings(max_examples=40)
@given(
    probes=st.integers(1, 60),
    count=st.integers(1, 60),
    k=st.integers(1, 70),
    lifted_probes=st.booleans(),
    of_templates=st.booleans(),
    labels=st.integers(0, 4),
    side=st.sampled_from([64, 1024]),
    metric=st.sampled_from(METRICS),
)
def test_nearest_is_what_sorting_the_matrix_finds(
    probes: int,
    count: int,
    k: int,
    lifted_probes: bool,
    of_templates: bool,
    labels: int,
    side: int,
    metric: Metric,
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles, "_TILE_SIDE", side)
        patch.setattr(tiles, "_LEAST", 1)
        mine, theirs = (lift(units(60, 24, seed), strategy="random", m=3) for seed in (1, 2))
        # Half of the rows twice, so that there are ties.
        order = np.arange(60) % 30
        left = mine[order[:probes]] if lifted_probes else units(60, 24, 1)[order[:probes]]
        right = theirs[order[:count]]
        tags = None
        matrix = pairwise_distances(left, right, metric=metric)
        if labels:
            tags = np.arange(probes) % labels, np.arange(count) % 3
            matrix = np.where(tags[0][:, None] == tags[1], np.inf, matrix)
        matrix = matrix.T if of_templates else matrix
        options = {"metric": metric, "of_templates": of_templates, "labels": tags}
        found = nearest(left, right, k=k, threads=3, **options)
        order = np.argsort(matrix, axis=1, kind="stable")[:, :k]
        expected = np.take_along_axis(matrix, order, 1)
        there = np.isfinite(expected)
        width = order.shape[1]
        np.testing.assert_array_equal(found.distances[:, :width], expected)
        np.testing.assert_array_equal(found.indices[:, :width], np.where(there, order, -1))
        assert (found.indices[:, width:] == -1).all()
        assert np.isinf(found.distances[:, width:]).all()


@pytest.mark.parametrize("metric", METRICS)
def test_counts_are_those_of_the_matrix(metric: Metric, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "_TILE_SIDE", 64)
    monkeypatch.setattr(tiles, "_LEAST", 1)
    points = faces(150, 64).astype(np.float32)
    templates = lifted(faces(170, 64, 2), 4, 2)
    for probes in (points, lifted(points, 3, 3)):
        matrix = pairwise_distances(probes, templates, metric=metric)
        people = np.arange(150) // 2, np.arange(170) // 3
        thresholds = np.concatenate(
            [np.quantile(matrix, [0.5, 0.01, 0.99]), matrix[3, :4], [-1.0, 0.0, 9.0, np.inf]]
        )
        seen = count_within(probes, templates, thresholds, metric=metric)
        np.testing.assert_array_equal(seen, [(matrix <= t).sum() for t in thresholds])
        others = people[0][:, None] != people[1]
        seen = count_within(probes, templates, thresholds, metric=metric, labels=people)
        np.testing.assert_array_equal(seen, [(matrix <= t)[others].sum() for t in thresholds])
        one = matrix[5, 5].astype(np.float64)
        between = count_within(probes, templates, one - 1e-12, metric=metric)
        assert between == count_within(probes, templates, one, metric=metric) - 1


def test_memory_does_not_grow_with_the_number_of_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "_TILE_SIDE", 256)
    monkeypatch.setattr(tiles, "_BLOCK_BYTES", 1 << 20)
    templates = lifted(faces(400, 64), 3, 1)
    people = np.arange(20_000) % 7, np.arange(400) % 5

    def peak(rows: int) -> int:
        points = np.resize(faces(400, 64, 2).astype(np.float32), (rows, 64))
        tags = people[0][:rows], people[1]
        tracemalloc.start()
        count_within(points, templates, [0.5, 1.0], metric="spherical", labels=tags)
        nearest(points, templates, k=2, metric="euclidean", labels=tags, of_templates=True)
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    peak(20_000)  # leaves its working space to the next
    small, large = peak(4_000), peak(20_000)
    assert 20_000 * 400 * 4 > 30e6
    assert large < small + 1_500_000


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: nearest(t, t, k=0, metric="euclidean"), "at least 1"),
        (lambda t: count_within(t, t, [[1.0]], metric="euclidean"), "a row of numbers"),
        (lambda t: count_within(t, t, [np.nan], metric="euclidean"), "a row of numbers"),
        (lambda t: count_within(t, t, [], metric="euclidean"), "a row of numbers"),
        (lambda t: nearest(t, t, k=1, metric="euclidean", threads=0), "at least 1 is needed"),
        (
            lambda t: pairwise_distances(t, t, metric="euclidean", threads=-1),
            "at least 1 is needed",
        ),
        (
            lambda t: count_within(
                t, t, [1.0], metric="euclidean", labels=(np.arange(3), np.arange(4))
            ),
            "do not fit 4 probes and 4 templates",
        ),
        (
            lambda t: nearest(
                t, t, k=1, metric="euclidean", labels=(np.arange(4) + 0.5, np.arange(4))
            ),
            "labels are whole numbers",
        ),
        (lambda t: pairwise_distances(t, t, metric="euclidean", steps=0), "one step"),
    ],
)
def test_wrong_parameters_are_refused(call, message: str) -> None:
    with pytest.raises(TemplateError, match=message):
        call(lift(units(4, 24), strategy="random", m=2))


def test_nothing_in_nothing_out() -> None:
    templates = lift(units(4, 24), strategy="random", m=2)
    none = np.empty((0, 24), dtype=np.float32)
    found = nearest(none, templates, k=2, metric="euclidean")
    assert found.indices.shape == found.distances.shape == (0, 2)
    found = nearest(none, templates, k=2, metric="euclidean", of_templates=True)
    assert (found.indices == -1).all()
    assert count_within(none, templates, [1.0], metric="euclidean") == 0


@pytest.mark.parametrize("size", [1e-25, 1e-12, 1e12, 3e19, 1e25])
def test_the_length_of_a_point_does_not_count_on_the_sphere(size: float) -> None:
    templates = lift(units(20, 24), strategy="random", m=2)
    points = units(3, 24, 1)
    seen = pairwise_distances((size * points).astype(np.float32), templates, metric="spherical")
    expected = pairwise_distances(points, templates, metric="spherical")
    np.testing.assert_allclose(seen, expected, rtol=1e-5)


def test_what_is_infinite_in_float32_is_refused() -> None:
    templates = lift(units(4, 24), strategy="random", m=2)
    far = 1e39 * units(3, 24, 1)
    for call in (
        lambda: pairwise_distances(far, templates, metric="spherical"),
        lambda: count_within(far, templates, [1.0], metric="euclidean"),
    ):
        with pytest.raises(InvalidEmbedding, match="not finite"):
            call()


def test_several_threads_take_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise no test would see how their collections are put together."""
    monkeypatch.setattr(tiles, "_TILE_SIDE", 64)
    monkeypatch.setattr(tiles, "_LEAST", 1)
    seen: set[int] = set()

    class Collector:
        def take(self, rows: slice, columns: slice, distances: np.ndarray) -> None:
            seen.add(threading.get_ident())
            barrier.wait()

    barrier = threading.Barrier(2, timeout=PATIENCE_S)
    templates = lifted(faces(64, 64), 3, 1)
    options = {"metric": Metric.EUCLIDEAN, "steps": 1, "threads": 2}
    parts = tiles.traverse(templates, templates, Collector, **options)
    assert len(parts) == len(seen) == 2


def test_nothing_of_a_traversal_is_left_in_the_working_space() -> None:
    pairwise_distances(units(40, 64), lifted(faces(200, 64), 3, 1), metric="spherical")
    assert tiles._ThreadSpace.spare
    tiles._ThreadSpace.spare.clear()
    templates = lifted(faces(300, 64), 3, 1)
    pairwise_distances(templates, templates, metric="spherical")
    (kept, *_) = tiles._ThreadSpace.spare
    assert not kept.any()


def test_huge_numbers_are_recomputed() -> None:
    """Squares overflow float32: never NaN."""
    templates = lift(units(20, 24), strategy="random", m=2)
    far = (1e25 * units(3, 24, 1)).astype(np.float32)
    seen = pairwise_distances(far, templates, metric="euclidean")
    expected = pairwise_distances(far, templates, metric="euclidean", dtype=np.float64)
    np.testing.assert_allclose(seen, expected, rtol=1e-5)


# --- compilation -------------------------------------------------------------------------------

_COMPILED = """
import numpy as np
from numba.core import event
from templates.distances import nearest, paired_distances, pairwise_distances, count_within, warm_up
from templates.space.lifting import lift

warm_up()
compiled = []

class Listener(event.Listener):
    def on_start(self, event):
        compiled.append(event.data["dispatcher"].__name__)

    def on_end(self, event):
        pass

event.register("numba:compile", Listener())
rng = np.random.default_rng(0)
rows = rng.normal(size=(30, 64))
rows /= np.linalg.norm(rows, axis=1, keepdims=True)
for m, k in ((1, 1), (2, 9), (16, 16), (20, 7)):
    a, b = (lift(rows, strategy="random", m=dim) for dim in (m, k))
    for metric in ("euclidean", "spherical"):
        for probes in (a, rows, rows.astype(np.float32), rows.astype(np.float32)[::2]):
            pairwise_distances(probes, b, metric=metric)
            nearest(probes, b, k=3, metric=metric)
            labels = np.arange(len(probes)), np.arange(30)
            labels[0].flags.writeable = False
            nearest(probes, b, k=3, metric=metric, of_templates=True, labels=labels)
            count_within(probes, b, [0.5], metric=metric)
        paired_distances(a, b, metric=metric)
print(compiled)
"""


def run(script: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env={**os.environ, **environment},
        cwd=Path(__file__).resolve().parents[3],
    )


def test_nothing_is_compiled_after_the_warm_up() -> None:
    done = run(_COMPILED)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_where_no_folder_takes_the_cache_a_kernel_is_compiled_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nowhere(*_: object, **__: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    def half(value: float) -> float:
        return value / 2

    monkeypatch.setattr(caching.CacheImpl, "__init__", nowhere)
    assert lanes.compiled(half)(3.0) == 1.5


@pytest.mark.long
def test_an_installation_that_cannot_be_written_to_compiles_anew(tmp_path: Path) -> None:
    script = """
from templates.distances.kernels import lanes
import numba.core.caching as caching

def nowhere(self, *_, **__):
    raise RuntimeError("cannot cache function: no locator available")

caching.CacheImpl.__init__ = nowhere
import numpy as np
from templates.distances import pairwise_distances
from templates.space.lifting import lift
rows = np.eye(24)[:4]
print(pairwise_distances(rows, lift(rows, strategy="random", m=3), metric="euclidean").shape)
"""
    done = run(script)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(4, 4)"


def test_the_warm_up_can_be_repeated() -> None:
    warm_up()
    warm_up()
