"""Distances on tensors: the specification's, whatever the tiles, and the same through a device."""

from collections.abc import Iterator

import numpy as np
import pytest

from templates import distances as entrance
from templates.distances import Metric, pairwise_distances, similarity
from templates.errors import InvalidEmbedding, InvalidTemplate, TemplateError
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.templates.distances.test_distances import faces, pairs, randoms, units

torch = pytest.importorskip("torch", reason="torch is an optional extra")

from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

from templates.distances import torch as on_device  # noqa: E402
from templates.distances.torch import (  # noqa: E402
    SubspaceTensors,
    counts_within,
    nearest,
    paired,
    pairwise,
)

SHAPES = [(1, 1, 64), (3, 3, 128), (8, 5, 64), (5, 8, 512), (1, 6, 128), (16, 16, 128), (20, 3, 64)]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def tensors(batch: SubspaceBatch) -> SubspaceTensors:
    return SubspaceTensors.of(batch, "cpu")


def distances(
    probes: SubspaceBatch | np.ndarray, templates: SubspaceBatch, **options
) -> np.ndarray:
    lifted = isinstance(probes, SubspaceBatch)
    mine = tensors(probes) if lifted else torch.tensor(probes.astype(np.float32))
    return pairwise(mine, tensors(templates), **{"steps": 50} | options).numpy()


def reference(
    probes: SubspaceBatch | np.ndarray, templates: SubspaceBatch, **options
) -> np.ndarray:
    options = {"steps": 300, "dtype": np.float64} | options
    if not isinstance(probes, SubspaceBatch):
        probes = probes.astype(np.float32)
    return pairwise_distances(probes, templates, **options)


# --- agreement with the reference in float64 ---------------------------------------------------


@pytest.mark.parametrize("metric", Metric)
@pytest.mark.parametrize("shape", SHAPES)
def test_subspaces_and_points_agree_with_the_reference(shape: tuple[int, ...], metric: Metric):
    m, k, n = shape
    a, b = faces(12, m, seed=1, n=n), faces(15, k, seed=2, n=n)
    seen = distances(a, b, metric=metric)
    assert seen.dtype == np.float32
    missing = similarity(reference(a, b, metric=metric)) - similarity(seen.astype(np.float64))
    assert missing.max() < 3e-6
    assert missing.min() > -1e-6
    points = units(Keystream.seeded("tensors"), 20, n)
    np.testing.assert_allclose(
        distances(points, b, metric=metric), reference(points, b, metric=metric), rtol=2e-6
    )


@pytest.mark.parametrize("metric", Metric)
@pytest.mark.parametrize("name", pairs())
def test_every_relation_of_two_subspaces(name: str, metric: Metric):
    a, b = (SubspaceBatch.of([subspace]) for subspace in pairs()[name])
    for one, two in ((a, b), (b, a)):
        expected = reference(one, two, metric=metric)
        seen = distances(one, two, metric=metric)
        assert (seen >= 0).all()
        np.testing.assert_allclose(seen, expected, rtol=3e-6, atol=1e-6)


@pytest.mark.parametrize("metric", Metric)
def test_shared_decoys_are_computed_from_differences(metric: Metric):
    """All pairs share a decoy, so all distances are 0 and no product in float32 can say so."""
    stream = Keystream.seeded("shared")
    members, decoys = units(stream, 16, 64), units(stream, 32, 64).reshape(16, 2, 64)
    decoys[:, 0] = decoys[0, 0]
    batch = SubspaceBatch.through(members, decoys - members[:, None], stream=stream)
    seen = distances(batch[:8], batch[8:], metric=metric)
    assert (seen >= 0).all()
    assert seen.max() < 1e-5


@pytest.mark.parametrize("metric", Metric)
def test_points_near_and_on_a_set(metric: Metric):
    templates = faces(5, 6, seed=3)
    inside = templates.feet + templates.radii[:, None] * templates.bases[:, 0]
    points = np.concatenate([inside, inside + 0.03 * units(Keystream.seeded(1), 5, 128)])
    expected = reference(points, templates, metric=metric)
    assert (expected < 0.1).sum() == 10
    np.testing.assert_allclose(
        distances(points, templates, metric=metric), expected, rtol=2e-6, atol=1e-7
    )


@pytest.mark.parametrize("scale", [1.5, 40.0, 1e25])
@pytest.mark.parametrize("metric", Metric)
def test_sets_outside_the_sphere_and_squares_that_overflow(metric: Metric, scale: float):
    axes = np.eye(64)
    outside = SubspaceBatch((scale * axes[5])[None], axes[None, :3])
    templates = faces(6, 4, seed=4, n=64)
    points = np.vstack([units(Keystream.seeded(2), 4, 64), np.zeros((1, 64))])
    for probes, others in ((outside, templates), (templates, outside), (points, outside)):
        np.testing.assert_allclose(
            distances(probes, others, metric=metric),
            reference(probes, others, metric=metric),
            rtol=3e-6,
        )


# --- the spherical iteration -------------------------------------------------------------------


def test_steps_raise_the_similarity_and_never_above_the_truth():
    a, b = faces(10, 16, seed=5), faces(11, 16, seed=6)
    truth = similarity(reference(a, b, metric="spherical"))
    before = np.full(truth.shape, -1.0)
    for steps in (1, 2, 4, 8, 9, 20, 50):
        seen = similarity(distances(a, b, metric=Metric.SPHERICAL, steps=steps).astype(np.float64))
        assert (seen <= truth + 1e-6).all()
        assert (seen >= before - 1e-6).all()
        if steps == 4:
            assert (truth - seen > 1e-4).mean() > 0.3
        before = seen
    assert (truth - before).max() < 3e-6


# --- tiles, memory, streams --------------------------------------------------------------------


class Largest(TorchDispatchMode):
    """Remember the size of the largest tensor that any operation returned."""

    def __init__(self):
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for part in result if isinstance(result, (tuple, list)) else [result]:
            if isinstance(part, torch.Tensor):
                self.bytes = max(self.bytes, part.numel() * part.element_size())
        return result


@pytest.mark.long
@pytest.mark.parametrize("metric", Metric)
@pytest.mark.parametrize("lifted", [True, False])
def test_tiles_bound_the_memory_and_do_not_show(
    metric: Metric, lifted: bool, monkeypatch: pytest.MonkeyPatch
):
    tile = 1 << 16
    options = {"metric": metric, "steps": 20}
    for rows, columns in ((60, 70) if lifted else (300, 200), (2, 2000)):
        templates = tensors(randoms(columns, 5, seed=8))
        points = units(Keystream.seeded(3), rows).astype(np.float32)
        probes = tensors(randoms(rows, 4, seed=7)) if lifted else torch.tensor(points)
        with Largest() as unbounded:
            whole = pairwise(probes, templates, **options)
        with monkeypatch.context() as patch:
            patch.setitem(on_device.TILE_BYTES, "cpu", tile)
            tiled = pairwise(probes, templates, **options)
            with Largest() as bounded:
                nearest(probes, templates, k=3, **options)
                counts_within(probes, templates, np.array([0.5, 1.0]), **options)
        torch.testing.assert_close(tiled, whole, atol=5e-6, rtol=0)
        # The stacked rows of all templates are large even where there are few pairs.
        assert bounded.bytes <= 3 * tile < unbounded.bytes


def lattice() -> tuple[np.ndarray, SubspaceBatch]:
    """Points and templates whose products are exact, so that equal distances are equal numbers."""
    axes = np.eye(16)
    points = np.vstack([axes[:8], (axes[8] + axes[9] + axes[10] + axes[11])[None] / 2])
    feet = np.vstack([0.5 * axes[(3 * i) % 8 : (3 * i) % 8 + 1] for i in range(23)])
    bases = np.stack([axes[[8 + i % 4, 12 + i % 3]] for i in range(23)])
    return points, SubspaceBatch(feet, bases)


@pytest.mark.parametrize("k", [1, 4, 30])
@pytest.mark.parametrize("metric", Metric)
def test_nearest_sorts_ties_by_index_and_leaves_labels_out(
    metric: Metric, k: int, monkeypatch: pytest.MonkeyPatch
):
    points, templates = lattice()
    labels = np.arange(9) % 3, np.arange(23) % 4
    expected = np.round(reference(points, templates, metric=metric), 5)
    assert len(np.unique(expected[0])) < 8
    monkeypatch.setitem(on_device.TILE_BYTES, "cpu", 512)
    for left_out in (None, labels):
        table = expected.copy()
        if left_out is not None:
            table[labels[0][:, None] == labels[1]] = np.inf
        table = np.pad(table, ((0, 0), (0, 10)), constant_values=np.inf)
        order = np.argsort(table, axis=1, kind="stable")[:, :k]
        table = np.take_along_axis(table, order, axis=1)
        indices, found = nearest(
            torch.tensor(points.astype(np.float32)),
            tensors(templates),
            k=k,
            metric=metric,
            labels=left_out,
            steps=50,
        )
        assert indices.dtype == torch.int64
        np.testing.assert_array_equal(indices, np.where(np.isinf(table), -1, order))
        np.testing.assert_allclose(found, table, atol=1e-5)


@pytest.mark.parametrize("metric", Metric)
def test_nearest_and_counts_are_those_of_the_matrix(
    metric: Metric, monkeypatch: pytest.MonkeyPatch
):
    a, b = tensors(faces(40, 4, seed=9)), tensors(faces(37, 3, seed=10))
    labels = np.arange(40) % 7, np.arange(37) % 5
    monkeypatch.setitem(on_device.TILE_BYTES, "cpu", 1 << 14)
    matrix = pairwise(a, b, metric=metric, steps=50).numpy()
    options = {"metric": metric, "steps": 50}
    indices, found = (part.numpy() for part in nearest(a, b, k=5, **options))
    order = np.argsort(matrix, axis=1, kind="stable")[:, :5]
    np.testing.assert_array_equal(indices, order)
    np.testing.assert_array_equal(found, np.take_along_axis(matrix, order, axis=1))
    # Thresholds that are distances tell "up to" from "below".
    thresholds = np.sort(np.concatenate([matrix.ravel()[::100], [0, 0.7, 5]])).astype(np.float64)
    for left_out in (None, labels):
        kept = matrix.ravel()
        if left_out is not None:
            kept = matrix[labels[0][:, None] != labels[1]]
        expected = [(kept <= threshold).sum() for threshold in thresholds]
        seen = counts_within(a, b, thresholds, labels=left_out, **options)
        assert seen.dtype == torch.int64
        np.testing.assert_array_equal(seen, expected)
    assert seen[-1] < matrix.size


@pytest.mark.parametrize("metric", Metric)
def test_empty_sides_give_empty_results(metric: Metric):
    a, options = tensors(faces(3, 2, seed=11)), {"metric": metric, "steps": 50}
    assert pairwise(a[:0], a, **options).shape == (0, 3)
    assert pairwise(a, a[:0], **options).shape == (3, 0)
    indices, found = nearest(a, a[:0], k=2, **options)
    assert (indices == -1).all()
    assert torch.isinf(found).all()
    assert counts_within(a, a[:0], np.array([9.0]), **options).tolist() == [0]


# --- precision of the products -----------------------------------------------------------------


@pytest.mark.parametrize("setting", ["older", "newer"])
def test_products_are_float32_and_the_setting_is_restored(
    setting: str, monkeypatch: pytest.MonkeyPatch
):
    matmul, seen = torch.backends.cuda.matmul, []
    make = on_device._distances

    def spy(*arguments):
        seen.append((torch.get_float32_matmul_precision(), torch.is_autocast_enabled("cpu")))
        return make(*arguments)

    monkeypatch.setattr(on_device, "_distances", spy)
    a = tensors(faces(3, 2, seed=12))
    if setting == "newer" and not hasattr(matmul, "fp32_precision"):
        pytest.skip("this torch has only the older setting")
    try:
        if setting == "older":
            torch.set_float32_matmul_precision("high")
        else:
            matmul.fp32_precision = "tf32"
        with torch.autocast("cpu", dtype=torch.bfloat16):
            pairwise(a, a, metric=Metric.EUCLIDEAN, steps=1)
        assert seen == [("highest", False)]
        if setting == "older":
            assert torch.get_float32_matmul_precision() == "high"
        else:
            assert matmul.fp32_precision == "tf32"
    finally:
        torch.set_float32_matmul_precision("highest")


def test_tensors_hold_what_the_batch_held():
    batch = faces(4, 3, seed=13)
    whole = tensors(batch)
    assert (len(whole), whole.n, whole.m, whole.device.type) == (4, 128, 3, "cpu")
    part = whole[1:3]
    np.testing.assert_array_equal(part.bases, batch.bases[1:3])
    np.testing.assert_array_equal(whole[torch.tensor([2, 0])].feet, batch.feet[[2, 0]])


# --- the one entrance --------------------------------------------------------------------------


@pytest.mark.parametrize("metric", list(Metric))
def test_a_device_gives_what_the_processor_gives(metric: Metric) -> None:
    stream = Keystream.seeded("entrance")
    rows = stream.normal((70, 64))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    a = lift(rows[:30], strategy="random", m=3, stream=stream)
    b = lift(rows[30:], strategy="random", m=5, stream=stream)
    labels = np.arange(30) % 4, np.arange(40) % 3
    calls = [
        lambda probes: pairwise_distances(probes, b, metric=metric),
        lambda probes: entrance.paired_distances(probes, b[:30], metric=metric),
        lambda probes: entrance.nearest(probes, b, k=4, metric=metric, labels=labels),
        lambda probes: entrance.nearest(probes, b, k=4, metric=metric, of_templates=True),
        lambda probes: entrance.count_within(probes, b, [1.3, 0.2, 0.8], metric=metric),
        lambda probes: entrance.count_within(probes, b, 0.9, metric=metric, labels=labels),
    ]
    for probes in (a, rows[:30]):
        for call in calls:
            here = call(probes)
            with entrance.on_device("cpu"):
                there = call(probes)
            assert type(there) is type(here)
            for left, right in zip(there, here, strict=True):
                np.testing.assert_allclose(left, right, atol=2e-5)


def test_a_device_holds_for_the_block_alone_and_not_for_float64(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    used = []

    def spied(name: str):
        make = getattr(on_device, name)

        def spy(*sides, **options):
            used.append(name)
            return make(*sides, **options)

        return spy

    for name in ("pairwise", "paired"):
        monkeypatch.setattr(on_device, name, spied(name))
    templates = faces(4, 3, seed=14)
    options = {"metric": Metric.EUCLIDEAN}
    with entrance.on_device("cpu"):
        pairwise_distances(templates, templates, **options)
        pairwise_distances(templates, templates, dtype=np.float64, **options)
        entrance.paired_distances(templates, templates, **options)
        with entrance.on_device(None):
            pairwise_distances(templates, templates, **options)
    pairwise_distances(templates, templates, **options)
    assert used == ["pairwise", "paired"]


@pytest.mark.parametrize("metric", list(Metric))
def test_paired_tiles_do_not_show(metric: Metric, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = faces(20, 4, seed=15), faces(20, 4, seed=16)
    b = SubspaceBatch(
        np.concatenate([a.feet[:1], b.feet[1:]]), np.concatenate([a.bases[:1], b.bases[1:]])
    )
    whole = paired(tensors(a), tensors(b), metric=metric, steps=50).numpy()
    monkeypatch.setitem(on_device.TILE_BYTES, "cpu", 1 << 14)
    tiled = paired(tensors(a), tensors(b), metric=metric, steps=50).numpy()
    expected = np.diagonal(reference(a, b, metric=metric))
    np.testing.assert_allclose(tiled, whole, atol=5e-6)
    np.testing.assert_allclose(similarity(whole), similarity(expected), atol=3e-6)
    assert whole[0] < 1e-5


def test_a_search_on_a_device_reports_every_pair() -> None:
    done: list[int] = []
    templates = faces(4, 3, seed=17)
    with entrance.on_device("cpu"):
        entrance.nearest(templates.feet, templates, k=1, metric="euclidean", progress=done.append)
        entrance.count_within(
            templates.feet, templates, 1.0, metric="euclidean", progress=done.append
        )
    assert done == [16, 16]


def test_what_a_device_cannot_do_is_said() -> None:
    rows = np.eye(24)[:4]
    templates = lift(rows, strategy="random", m=2)
    refused = pytest.raises(TemplateError, match="cannot use the device nowhere")
    with refused, entrance.on_device("nowhere"):
        pairwise_distances(rows, templates, metric="euclidean")
    if not torch.cuda.is_available():
        refused = pytest.raises(TemplateError, match="cannot use the device cuda")
        with refused, entrance.on_device("cuda"):
            entrance.nearest(rows, templates, k=1, metric="euclidean")
    with entrance.on_device("cpu"):
        with pytest.raises(TemplateError, match="an array or a batch"):
            pairwise_distances(torch.tensor(rows), templates, metric="euclidean")
        with pytest.raises(InvalidEmbedding, match="not finite"):
            pairwise_distances(np.full((1, 24), np.nan), templates, metric="euclidean")
        with pytest.raises(InvalidEmbedding, match="shape"):
            entrance.nearest(rows[:, :5], templates, k=1, metric="euclidean")
        other = lift(np.eye(25)[:4], strategy="random", m=2)
        with pytest.raises(InvalidTemplate, match="does not fit"):
            entrance.count_within(other, templates, [1.0], metric="euclidean")
