import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest

from models.errors import ModelError, ProviderUnavailable
from models.sessions import Session, available_providers, resolve_providers
from tests.models.graphs import pooled, pooling_embedder


def feed(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    crop = np.random.default_rng(seed).integers(0, 256, (1, 112, 112, 3), dtype=np.uint8)
    x = ((crop.astype(np.float32) - 127.5) / 127.5).transpose(0, 3, 1, 2)
    return np.ascontiguousarray(x), pooled(crop)


def test_an_absent_accelerator_is_an_error_that_names_what_is_there():
    absent = next(n for n in ("cuda", "rocm", "coreml") if n not in available_providers())
    with pytest.raises(ProviderUnavailable, match=rf": {absent}; available are: .*cpu"):
        Session(pooling_embedder(), name="x.onnx", providers=(absent, "cpu"))


@pytest.mark.parametrize("names", [(), ("gpu",), ("cpu", "nonsense")])
def test_unknown_or_no_providers(names):
    with pytest.raises(ProviderUnavailable, match="cpu"):
        resolve_providers(names)


def test_a_provider_that_does_not_start_is_an_error(monkeypatch):
    """onnxruntime drops a provider whose libraries are missing and goes on with the CPU."""
    there = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(ort, "get_available_providers", lambda: there)
    real = ort.InferenceSession

    def drop(model, options, providers, **rest):
        return real(model, options, providers=["CPUExecutionProvider"], **rest)

    monkeypatch.setattr(ort, "InferenceSession", drop)
    with pytest.raises(ProviderUnavailable, match="did not start"):
        Session(pooling_embedder(), name="x.onnx", providers=("cuda",))


def test_a_failed_run_says_nothing_of_its_input():
    session = Session(pooling_embedder(), name="x.onnx")
    with pytest.raises(ModelError, match=r"x\.onnx: inference failed") as caught:
        session.run({"image": np.full((1, 3, 7, 7), 123.25, np.float32)})
    assert "123" not in str(caught.value)
    assert caught.value.__suppress_context__


MEMORY = """
import sys
from pathlib import Path
import numpy as np
from models.sessions import Session

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

path = Path(sys.argv[1])
session = Session(path.read_bytes(), name=path.name, threads=1)
rng = np.random.default_rng(0)
largest = np.zeros((1, 3, 640, 640), np.float32)
session.run({"input": largest})
session.run({"input": largest})
before = resident()
for height, width in rng.permutation([(h, w) for h in range(1, 21) for w in range(1, 21)])[:200]:
    session.run({"input": np.zeros((1, 3, height * 32, width * 32), np.float32)})
print(resident() - before)
"""


@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="needs Linux's /proc to see memory"
)
def test_two_hundred_input_sizes_do_not_grow_memory(yunet_pack_dir):
    """In a process of its own: the sizes are all below the one that was seen first."""
    grown = subprocess.run(
        [sys.executable, "-c", MEMORY, str(yunet_pack_dir / "yunet_n_dynamic.onnx")],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
    )
    assert float(grown.stdout) < 40
