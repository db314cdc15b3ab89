import contextlib

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper

from models.errors import PackError
from models.signature import FIRST_NODES, Role, Signature, Tensor, classify, read_signature
from tests.models import graphs


def role_of(model: bytes, **options) -> Role:
    return classify(read_signature(model, name="x.onnx"), **options)[0]


def net(size, outputs, channels=3):
    return graphs.shaped([("data", ["N", channels, *size])], outputs)


@pytest.mark.parametrize(
    ("model", "role"),
    [
        (graphs.scrfd_shapes(), Role.SCRFD),
        (graphs.scrfd_shapes(batched=True), Role.SCRFD),
        (graphs.scrfd_shapes(keypoints=False), Role.SCRFD_WITHOUT_KEYPOINTS),
        (graphs.yunet_shapes(), Role.YUNET),
        (net((96, 96), [("fc1", [1, 3])]), Role.GENDER_AGE),
        (net((192, 192), [("fc1", [1, 212])]), Role.LANDMARKS),
        (net((192, 192), [("fc1", [1, 3309])]), Role.LANDMARKS),
        (net((112, 112), [("683", [1, 512])]), Role.EMBEDDER),
        (net((128, 128), [("e", ["N", 256])]), Role.EMBEDDER),
        (net((112, 112), [("a", [1, 512]), ("b", [1, 512])]), Role.UNKNOWN),
        (net((112, 112), [("a", [1, 512, 1, 1])]), Role.UNKNOWN),
        (net((112, 96), [("a", [1, 512])]), Role.UNKNOWN),
        (net((120, 120), [("a", [1, 512])]), Role.UNKNOWN),
        (net((96, 96), [("a", [1, 512])]), Role.UNKNOWN),
        (net((112, 112), [("a", [1, 512])], channels=1), Role.UNKNOWN),
        (net((80, 80), [("output", ["N", 3])]), Role.LIVENESS),
        (net((80, 80), [("output", ["N", 2])]), Role.UNKNOWN),
        # Two or three numbers are no embedding, whatever the size.
        (net((128, 128), [("output", ["N", 2])]), Role.UNKNOWN),
        (net((112, 112), [("output", ["N", 3])]), Role.UNKNOWN),
        (graphs.shaped([("a", [1, 4]), ("b", [1, 4])], [("o", [1, 4])]), Role.UNKNOWN),
    ],
)
def test_routing_by_signature(model, role):
    assert role_of(model) is role


def test_an_open_input_size_is_an_embedder_once_it_is_stated():
    model = net(("h", "w"), [("e", ["N", 512])])
    assert role_of(model) is Role.UNKNOWN
    assert role_of(model, input_size=112) is Role.EMBEDDER
    assert "pack.toml" in classify(read_signature(model, name="x"))[1]


def embedder_with_nodes(kinds: list[str]) -> bytes:
    """A chain of one-input nodes of these kinds."""
    nodes, name = [], "data"
    for i, kind in enumerate(kinds):
        inputs = [name, "one"] if kind in ("Sub", "Mul", "Div", "Add") else [name]
        nodes.append(helper.make_node(kind, inputs, [f"t{i}"]))
        name = f"t{i}"
    graph = helper.make_graph(
        nodes,
        "chain",
        [helper.make_tensor_value_info("data", TensorProto.FLOAT, [1, 3, 112, 112])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 512])],
        [helper.make_tensor("one", TensorProto.FLOAT, [], [1.0])],
    )
    return helper.make_model(graph).SerializeToString()


@pytest.mark.parametrize(
    ("kinds", "inside"),
    [
        (["Sub", "Mul", "Relu"], True),
        (["Relu", "Sub", "Div"], True),
        (["Relu"] * 6 + ["Sub", "Mul"], True),
        (["Relu"] * 7 + ["Sub", "Mul"], False),
        (["Sub", "Relu"], False),
        (["Mul", "Div", "Relu"], False),
        (["Relu", "Add"], False),
    ],
)
def test_normalisation_inside_is_told_from_the_first_eight_nodes(kinds, inside):
    assert read_signature(embedder_with_nodes(kinds), name="x").normalises is inside


def test_weights_listed_as_inputs_do_not_count():
    proto = onnx.load_model_from_string(graphs.pooling_embedder())
    proto.graph.input.append(helper.make_tensor_value_info("factor", TensorProto.FLOAT, []))
    assert role_of(proto.SerializeToString()) is Role.EMBEDDER


@pytest.mark.parametrize("junk", [b"", b"\0" * 50, b"<html>not found</html>", b"\x08\x07"])
def test_what_is_no_model_is_named(junk):
    with pytest.raises(PackError, match=r"some\.onnx is not a readable ONNX model"):
        read_signature(junk, name="some.onnx")


def test_a_truncated_model_is_named():
    model = graphs.pooling_embedder()
    with pytest.raises(PackError, match="not a readable"):
        read_signature(model[: len(model) // 2], name="some.onnx")


def elsewhere(tensor: onnx.TensorProto) -> None:
    tensor.CopyFrom(onnx.numpy_helper.from_array(np.ones(4, np.float32), tensor.name))
    onnx.external_data_helper.set_external_data(tensor, location="../../secret")
    tensor.ClearField("raw_data")


@pytest.mark.parametrize("place", ["initializer", "constant", "branch"])
def test_weights_in_another_file_are_refused(place):
    """They would escape the fingerprint, and their path is the file's to choose."""
    proto = onnx.load_model_from_string(graphs.pooling_embedder())
    if place == "initializer":
        elsewhere(proto.graph.initializer[0])
    else:
        node = proto.graph.node.add(op_type="Constant", output=["c"])
        attribute = node.attribute.add(name="value", type=onnx.AttributeProto.TENSOR)
        elsewhere(attribute.t)
        if place == "branch":
            inner = proto.graph.node.add(op_type="If", output=["i"])
            branch = inner.attribute.add(name="then_branch", type=onnx.AttributeProto.GRAPH)
            branch.g.node.append(node)
            del proto.graph.node[-2]
    with pytest.raises(PackError, match="another file"):
        read_signature(proto.SerializeToString(), name="x.onnx")


def as_onnx_reads_it(model: bytes) -> Signature:
    graph = onnx.load_model_from_string(model).graph
    weights = {tensor.name for tensor in graph.initializer}

    def tensors(values) -> tuple[Tensor, ...]:
        return tuple(
            Tensor(
                value.name,
                tuple(
                    size.dim_value if size.HasField("dim_value") else None
                    for size in value.type.tensor_type.shape.dim
                ),
            )
            for value in values
            if value.name not in weights
        )

    kinds = tuple(node.op_type for node in graph.node[:FIRST_NODES])
    maker = next((n.op_type for n in graph.node if graph.output[0].name in n.output), "")
    return Signature(tensors(graph.input), tensors(graph.output), kinds, maker)


MADE = [
    graphs.scrfd_shapes(),
    graphs.yunet_shapes(),
    graphs.pooling_embedder(inside=True),
    graphs.shaped([("data", [0, -1, 2**40])], [("e", [1])]),
]


@pytest.mark.parametrize("model", MADE)
def test_what_is_read_is_what_the_onnx_package_reads(model):
    assert read_signature(model, name="x") == as_onnx_reads_it(model)


@given(st.sampled_from(MADE), st.data())
def test_a_broken_model_is_read_or_refused(model, data):
    place = data.draw(st.integers(0, len(model) - 1))
    broken = model[:place] + data.draw(st.binary(max_size=12)) + model[place + 3 :]
    with contextlib.suppress(PackError):
        read_signature(broken, name="some.onnx")


def test_real_packs(mbf_pack_dir, yunet_pack_dir, shared_data):
    seen = {
        path.name: (
            role_of(path.read_bytes()),
            read_signature(path.read_bytes(), name="x").normalises,
        )
        for folder in (mbf_pack_dir, yunet_pack_dir, shared_data / "packs" / "liveness")
        for path in folder.glob("*.onnx")
        if read_signature(path.read_bytes(), name="x") == as_onnx_reads_it(path.read_bytes())
    }
    assert seen == {
        "det_500m_kps.onnx": (Role.SCRFD, False),
        "w600k_mbf.onnx": (Role.EMBEDDER, False),
        "yunet_n_dynamic.onnx": (Role.YUNET, False),
        "mobilefacenet_y1_128d_fp32.onnx": (Role.EMBEDDER, True),
        "minifasnet_v2_2.7_80x80.onnx": (Role.LIVENESS, False),
        "minifasnet_v1se_4.0_80x80.onnx": (Role.LIVENESS, False),
    }
