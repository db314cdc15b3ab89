"""What a graph is, told from its inputs and outputs."""

import numpy as np
import onnx
import pytest

from models.errors import PackError
from models.pack_graphs import Role, classify, read_graphs
from models.sessions import Tensor
from tests.models.graphs import pooling_embedder

IMAGE = (None, 3, 112, 112)
SCRFD = [(cells, width) for width in (1, 4, 10) for cells in (12800, 3200, 800)]
YUNET = [f"{role}_{stride}" for role in ("cls", "obj", "bbox", "kps") for stride in (8, 16, 32)]


@pytest.mark.parametrize(
    ("image", "outputs", "role"),
    [
        ((1, 3, None, None), SCRFD, Role.SCRFD),
        ((1, 3, 640, 640), [(1, *shape) for shape in SCRFD], Role.SCRFD),
        ((1, 3, None, None), SCRFD[:6], Role.SCRFD_WITHOUT_KEYPOINTS),
        ((None, 3, 96, 96), [(1, 3)], Role.UNUSED),
        ((None, 3, 192, 192), [(1, 212)], Role.UNUSED),
        ((None, 3, 192, 192), [(1, 3309)], Role.UNUSED),
        (IMAGE, [(1, 512)], Role.EMBEDDER),
        ((None, 3, 128, 128), [(None, 256)], Role.EMBEDDER),
        ((None, None, 112, 112), [(None, None)], Role.EMBEDDER),
        ((None, 3, None, None), [(None, 512)], Role.UNUSED),
        (IMAGE, [(1, 512), (1, 512)], Role.UNUSED),
        (IMAGE, [(1, 512, 1, 1)], Role.UNUSED),
        (IMAGE, [()], Role.UNUSED),
        ((None, 3, 112, 96), [(1, 512)], Role.UNUSED),
        ((None, 3, 120, 120), [(1, 512)], Role.UNUSED),
        ((None, 3, 96, 96), [(1, 512)], Role.UNUSED),
        ((None, 1, 112, 112), [(1, 512)], Role.UNUSED),
        ((None, 3, 80, 80), [(None, 3)], Role.LIVENESS),
        ((None, 3, 80, 80), [(None, 2)], Role.UNUSED),
        # Two or three numbers are no embedding, whatever the size.
        ((None, 3, 128, 128), [(None, 2)], Role.UNUSED),
        (IMAGE, [(None, 3)], Role.UNUSED),
        ((1, 4), [(1, 512)], Role.UNUSED),
    ],
)
def test_routing_by_signature(image, outputs, role):
    made = [Tensor(f"o{place}", shape) for place, shape in enumerate(outputs)]
    assert classify([Tensor("data", image)], made)[0] is role
    assert classify([Tensor("data", image)] * 2, made)[0] is Role.UNUSED


@pytest.mark.parametrize(
    "junk", [b"", b"\0" * 50, b"<html>not found</html>", pooling_embedder()[:150]]
)
def test_what_is_no_model_is_named(tmp_path, junk):
    (tmp_path / "some.onnx").write_bytes(junk)
    with pytest.raises(PackError, match=r"some\.onnx is not a readable ONNX model"):
        read_graphs(tmp_path)


@pytest.mark.parametrize("is_constant", [False, True])
def test_weights_in_another_file_are_refused(tmp_path, monkeypatch, is_constant):
    """They would escape the fingerprint, and their path is the file's to choose."""
    proto = onnx.load_model_from_string(pooling_embedder())
    tensor = proto.graph.initializer[2]
    assert tensor.name == "factor"
    if is_constant:
        node = onnx.helper.make_node("Constant", [], ["factor"], value=tensor)
        proto.graph.node.insert(0, node)
        del proto.graph.initializer[2]
        tensor = proto.graph.node[0].attribute[0].t
    tensor.CopyFrom(onnx.numpy_helper.from_array(np.ones(1, np.float32), "factor"))
    onnx.external_data_helper.set_external_data(tensor, location="secret")
    tensor.ClearField("raw_data")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret").write_bytes(np.ones(1, np.float32).tobytes())
    (tmp_path / "x.onnx").write_bytes(proto.SerializeToString())
    with pytest.raises(PackError, match="weights lie in another file, convert"):
        read_graphs(tmp_path)


def test_real_packs(mbf_pack_dir, yunet_pack_dir, shared_data):
    folders = (mbf_pack_dir, yunet_pack_dir, shared_data / "packs" / "liveness")
    seen = {graph.file: graph.role for folder in folders for graph in read_graphs(folder)}
    assert seen == {
        "det_500m_kps.onnx": Role.SCRFD,
        "w600k_mbf.onnx": Role.EMBEDDER,
        "yunet_n_dynamic.onnx": Role.YUNET,
        "mobilefacenet_y1_128d_fp32.onnx": Role.EMBEDDER,
        "minifasnet_v2_2.7_80x80.onnx": Role.LIVENESS,
        "minifasnet_v1se_4.0_80x80.onnx": Role.LIVENESS,
    }
