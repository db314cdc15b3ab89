"""The nearest of a matrix that nobody holds; and which file computes it."""

import subprocess
import sys
from pathlib import Path

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
    warm_up,
)
from templates.errors import TemplateError
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from tests.patience import PATIENCE_S
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
    with pytest.raises(TemplateError, match=r"veilface\[evaluate\]"):
        warm_up()


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


def test_a_device_that_is_not_there_is_refused() -> None:
    backend("torch")
    rows = np.eye(24)[:4]
    templates = lift(rows, strategy="random", m=2)
    with pytest.raises(TemplateError, match="cannot use the device nowhere"), on_device("nowhere"):
        pairwise_distances(rows, templates, metric="euclidean")


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


_NOTHING_COMPILED = """
import numpy as np
from numba.core import event
from templates import distances
from templates.distances import compiled, warm_up
from templates.space.lifting import lift

warm_up()
names = []

class Listener(event.Listener):
    def on_start(self, event):
        names.append(event.data["dispatcher"].__name__)

    def on_end(self, event):
        pass

event.register("numba:compile", Listener())
distances._FEW = 0
rows = np.linalg.qr(np.random.default_rng(0).normal(size=(64, 64)))[0]
for m, k in ((1, 1), (2, 9), (16, 16), (20, 7)):
    a, b = (lift(rows, strategy="random", m=dim) for dim in (m, k))
    for metric in ("euclidean", "spherical"):
        for probes in (a, a[::2], rows, rows.astype(np.float32), rows.astype(np.float32)[::2]):
            distances.pairwise_distances(probes, b, metric=metric)
print(names)
"""


def test_nothing_is_compiled_after_the_warm_up() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", _NOTHING_COMPILED],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        cwd=Path(__file__).resolve().parents[3],
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_the_specification_needs_numpy_alone() -> None:
    script = (
        "import sys, numpy as np\n"
        "from templates.distances import pairwise_distances\n"
        "from templates.space.subspace import SubspaceBatch\n"
        "axes = np.eye(6)\n"
        "batch = SubspaceBatch(0.5 * axes[:1], axes[None, 1:3])\n"
        "for probes in (axes, batch):\n"
        "    pairwise_distances(probes, batch, metric='spherical')\n"
        "print(sorted({'numba', 'torch', 'llvmlite'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        cwd=Path(__file__).resolve().parents[3],
    )
    assert done.stdout.strip() == "[]", done.stderr
