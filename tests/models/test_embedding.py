import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.embedding import MAX_BATCH, Embedder, Preprocessing, normalises_inside
from models.errors import ModelError
from models.sessions import Session
from tests.models.graphs import pooled, pooling_embedder, unit


def embedder(model=None, *, size=112, **changes) -> Embedder:
    settings = {
        "alignment": "arcface-112",
        "size": size,
        "channel_order": "rgb",
        "mean": (127.5,) * 3,
        "scale": (127.5,) * 3,
        "flip": False,
    } | changes
    session = Session(model or pooling_embedder(), name="pooling.onnx", threads=1)
    return Embedder(session, Preprocessing(**settings))


POOLING = embedder()


def crops(count: int, seed: int = 0, size: int = 112) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, size, size, 3), dtype=np.uint8)


@settings(max_examples=10)
@given(st.integers(1, 2 * MAX_BATCH + 3), st.integers(0, 99))
def test_rows_are_the_normalised_output_whatever_the_batch(count, seed):
    pictures = crops(count, seed)
    rows = POOLING.embed(pictures, flip=False)
    np.testing.assert_allclose(rows, unit(pooled(pictures)), atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-6)
    assert rows.dtype == np.float32
    assert rows.flags.c_contiguous


def test_a_fixed_batch_is_filled_up():
    fixed = embedder(pooling_embedder(batch=4))
    pictures = crops(6)
    np.testing.assert_allclose(fixed.embed(pictures, flip=False), unit(pooled(pictures)), atol=2e-5)


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("batch", ["N", 3])
def test_normalisation_inside_a_graph_is_told_by_what_it_tells_apart(inside, batch):
    model = pooling_embedder(inside=inside, batch=batch)
    assert normalises_inside(Session(model, name="x.onnx", threads=1), 112) is inside


@pytest.mark.parametrize("factor", [0.0, float("nan"), float("inf")])
def test_a_zero_or_endless_output_is_an_error(factor):
    with pytest.raises(ModelError, match=r"pooling\.onnx"):
        embedder(pooling_embedder(factor=factor)).embed(crops(1), flip=False)
