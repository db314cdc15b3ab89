"""The nearest of a matrix that nobody holds; and which file computes it."""

import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from threadpoolctl import threadpool_limits

from templates import distances
from templates.distances import (
    nearest,
    on_device,
    paired_distances,
    pairwise_distances,
)
from templates.keys.randomness import Keystream
from tests.templates.distances.batches import (
    BACKENDS,
    METRICS,
    backend,
    faces,
    matrix,
    randoms,
    sorted_matrix,
    units,
)


@pytest.fixture(params=BACKENDS)
def name(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each of the three computes what these small problems need, in many small parts."""
    module, _ = backend(request.param)
    for size, value in {
        "_SIDE": 16,
        "_TASK_PAIRS": 256,
        "_TEMPLATE_ROWS": 64,
        "_TILE_BYTES": {"cpu": 1 << 15},
    }.items():
        if hasattr(module, size):
            monkeypatch.setattr(module, size, value)
    monkeypatch.setattr(distances, "_FEW", 0 if request.param == "compiled" else 1 << 40)
    with on_device("cpu" if request.param == "torch" else None):
        yield request.param


SET = randoms(60, 3, seed=2)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_nearest_is_what_sorting_the_matrix_finds(name: str, data: st.DataObject) -> None:
    draw = data.draw
    probes, count, k = draw(st.integers(1, 60)), draw(st.integers(1, 60)), draw(st.integers(1, 70))
    metric = draw(st.sampled_from(METRICS))
    # Half of the rows twice, so that there are ties.
    order = np.arange(60) % 30
    points = units(Keystream.seeded(3), 60)[order[:probes]].astype(np.float32)
    templates = SET[order[:count]]
    expected = sorted_matrix(pairwise_distances(points, templates, metric=metric).T, k)
    found = nearest(points, templates, k=k, metric=metric)
    np.testing.assert_allclose(found.distances, expected.distances, rtol=0, atol=5e-6)
    assert ((found.indices < 0) == (expected.indices < 0)).all()
    if name != "torch":  # whose products of equal rows may differ in the last bit
        np.testing.assert_array_equal(found.indices, expected.indices)


def test_nothing_in_nothing_out(name: str) -> None:
    templates = randoms(4, 2, seed=1)
    none = np.empty((0, 24), dtype=np.float32)
    for metric in METRICS:
        assert pairwise_distances(none, templates, metric=metric).shape == (0, 4)
        assert pairwise_distances(templates, templates[:0], metric=metric).shape == (4, 0)
        assert paired_distances(templates[:0], templates[:0], metric=metric).shape == (0,)
        found = nearest(none, templates, k=2, metric=metric)
        assert found.indices.shape == found.distances.shape == (4, 2)
        assert (found.indices == -1).all()


@pytest.mark.parametrize("metric", METRICS)
def test_threads_and_neighbours_do_not_change_a_distance(metric: str) -> None:
    a, b = faces(70, 5, seed=1, n=64), faces(90, 3, seed=2, n=64)
    for probes in (a, units(Keystream.seeded(5), 70, 64)):
        alone = matrix("compiled", probes, b, metric=metric)
        for threads in (2, 5):
            with threadpool_limits(threads, user_api="blas"):
                other = matrix("compiled", probes, b, metric=metric)
            np.testing.assert_allclose(other, alone, rtol=0, atol=2e-6)
        one = matrix("compiled", probes[7:8], b[31:32], metric=metric)
        assert one[0, 0] == pytest.approx(alone[7, 31], abs=2e-6)


# --- who computes ------------------------------------------------------------------------------


def test_few_pairs_are_left_to_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the extra everything is; a service never loads what it does not need."""
    used: list[str] = []
    for module in ("exact", "compiled"):
        made, _ = backend(module)
        monkeypatch.setattr(made, "tiles", lambda *_, of=module, **__: iter(used.append(of) or ()))
    points, templates = np.zeros((64, 24), np.float32), randoms(65, 2, seed=1)
    pairwise_distances(points, templates[:64], metric="spherical")
    pairwise_distances(points, templates, metric="spherical")
    monkeypatch.setitem(sys.modules, "templates.distances.compiled", None)
    monkeypatch.delattr(distances, "compiled")
    pairwise_distances(points, templates, metric="spherical")
    assert used == ["exact", "compiled", "exact"]


@pytest.mark.parametrize("metric", METRICS)
def test_a_device_holds_for_its_block_alone(metric: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch, _ = backend("torch")
    used: list[str] = []
    make = torch.tiles

    def spy(*sides, **options):
        used.append(options["device"])
        return make(*sides, **options)

    monkeypatch.setattr(torch, "tiles", spy)
    templates = faces(4, 3, seed=14)
    with on_device("cpu"):
        there = pairwise_distances(templates, templates, metric=metric)
        with on_device(None):
            here = pairwise_distances(templates, templates, metric=metric)
    assert used == ["cpu"]
    np.testing.assert_allclose(there, here, atol=2e-5)


def test_products_on_a_device_are_float32_and_the_setting_is_restored() -> None:
    made, _ = backend("torch")
    import torch

    try:
        torch.set_float32_matmul_precision("high")
        with torch.autocast("cpu", dtype=torch.bfloat16), made.ieee_products(torch.device("cpu")):
            assert torch.get_float32_matmul_precision() == "highest"
            assert not torch.is_autocast_enabled("cpu")
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision("highest")
