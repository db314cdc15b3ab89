"""What an ONNX graph is, told from its inputs, outputs and first nodes; never from its name."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import onnx
from onnx import ModelProto, TensorProto, ValueInfoProto

from models.errors import PackError
from models.yunet import OUTPUTS as YUNET_OUTPUTS

# Graphs whose first nodes both subtract and scale bring their own normalisation
# (docs/models.md "Packs"; the rule InsightFace uses).
FIRST_NODES = 8
_SCALES = {"Mul", "Div"}

Shape = tuple[int | None, ...]  # None: any size


class Role(StrEnum):
    """What a graph can do for a pack."""

    SCRFD = "scrfd"
    SCRFD_WITHOUT_KEYPOINTS = "scrfd-without-keypoints"
    YUNET = "yunet"
    GENDER_AGE = "gender-age"
    LANDMARKS = "landmarks"
    EMBEDDER = "embedder"
    UNKNOWN = "unknown"


DETECTORS = frozenset({Role.SCRFD, Role.YUNET})
_YUNET_NAMES = frozenset(YUNET_OUTPUTS)


@dataclass(frozen=True)
class Tensor:
    """Name and shape of a graph's input or output."""

    name: str
    shape: Shape


@dataclass(frozen=True)
class Signature:
    """The part of a graph that routing looks at."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    first_nodes: tuple[str, ...]

    @property
    def image_size(self) -> tuple[int | None, int | None] | None:
        """Height and width of the only input where it is an image, else ``None``."""
        if len(self.inputs) != 1:
            return None
        shape = self.inputs[0].shape
        if len(shape) != 4 or shape[1] not in (3, None):
            return None
        return shape[2], shape[3]

    @property
    def normalises(self) -> bool:
        """Whether normalisation is inside the graph, so that it wants 0...255."""
        return "Sub" in self.first_nodes and not _SCALES.isdisjoint(self.first_nodes)


def read_signature(model: bytes, *, name: str) -> Signature:
    """Parse a serialised graph.

    Raises
    ------
    PackError
        If the bytes are no ONNX model, or its weights lie in another file.
    """
    try:
        proto: ModelProto = onnx.load_model_from_string(model)
    # protobuf raises its own unrelated class.
    except Exception:
        raise PackError(f"{name} is not a readable ONNX model; fetch the file again.") from None
    graph = proto.graph
    if not graph.node:
        raise PackError(f"{name} is not a readable ONNX model: its graph is empty.")
    if any(tensor.data_location == TensorProto.EXTERNAL for tensor in _tensors(proto)):
        raise PackError(
            f"{name} keeps its weights in another file; convert it to a single .onnx file, so"
            " that its hash covers the weights."
        )
    # Up to IR version 3 the weights were listed among the inputs as well.
    weights = {tensor.name for tensor in graph.initializer}
    return Signature(
        inputs=tuple(_tensor(value) for value in graph.input if value.name not in weights),
        outputs=tuple(_tensor(value) for value in graph.output),
        first_nodes=tuple(node.op_type for node in graph.node[:FIRST_NODES]),
    )


def _tensors(proto: ModelProto) -> Iterator[TensorProto]:
    """Every tensor of a model: weights, constants of nodes, those of nested graphs."""
    graphs = [proto.graph]
    nodes = [node for function in proto.functions for node in function.node]
    while graphs or nodes:
        if graphs:
            graph = graphs.pop()
            yield from graph.initializer
            for sparse in graph.sparse_initializer:
                yield sparse.values
                yield sparse.indices
            nodes.extend(graph.node)
            continue
        for attribute in nodes.pop().attribute:
            yield attribute.t
            yield from attribute.tensors
            if attribute.HasField("g"):
                graphs.append(attribute.g)
            graphs.extend(attribute.graphs)


def _tensor(value: ValueInfoProto) -> Tensor:
    dims = value.type.tensor_type.shape.dim
    return Tensor(
        name=value.name,
        shape=tuple(d.dim_value if d.HasField("dim_value") else None for d in dims),
    )


def classify(signature: Signature, *, input_size: int | None = None) -> tuple[Role, str]:
    """Route a graph by its signature (docs/models.md "Packs").

    Parameters
    ----------
    input_size
        Side of the embedder's input as stated in ``pack.toml``, for graphs that leave it open.

    Returns
    -------
    role : Role
    reason : str
        One sentence that says what it was told from.
    """
    size = signature.image_size
    if size is None:
        return Role.UNKNOWN, f"{len(signature.inputs)} input(s), not one image (batch, 3, h, w)"
    if _YUNET_NAMES.issubset(output.name for output in signature.outputs):
        return Role.YUNET, "outputs cls_8 ... kps_32"
    detector = _scrfd(signature)
    if detector is not None:
        return detector
    values = [output.shape[-1] if output.shape else None for output in signature.outputs]
    if size == (96, 96) and values == [3]:
        return Role.GENDER_AGE, "96 x 96 input and 3 output values; ignored"
    if size == (192, 192):
        return Role.LANDMARKS, "192 x 192 input; ignored"
    return _embedder(signature, size, input_size)


def _scrfd(signature: Signature) -> tuple[Role, str] | None:
    last = sorted(output.shape[-1] or 0 if output.shape else 0 for output in signature.outputs)
    if last == [1, 1, 1, 4, 4, 4, 10, 10, 10]:
        return Role.SCRFD, "scores, boxes and five points at three strides (9 outputs)"
    if last == [1, 1, 1, 4, 4, 4]:
        return (
            Role.SCRFD_WITHOUT_KEYPOINTS,
            "scores and boxes at three strides without keypoints (6 outputs): it cannot align",
        )
    return None


def _embedder(
    signature: Signature, size: tuple[int | None, int | None], stated: int | None
) -> tuple[Role, str]:
    height, width = (stated if side is None else side for side in size)
    if height is None or width is None:
        return (
            Role.UNKNOWN,
            "the input size is open; where this is an embedder, state input_size in pack.toml",
        )
    if height != width or height < 112 or height % 16:
        return (
            Role.UNKNOWN,
            f"the {width} x {height} input is not a square of at least 112 that 16 divides",
        )
    if len(signature.outputs) != 1 or len(signature.outputs[0].shape) != 2:
        return Role.UNKNOWN, "no known detector, and not exactly one output (batch, values)"
    inside = "inside" if signature.normalises else "outside"
    return (
        Role.EMBEDDER,
        f"square {width} x {height} input and one 2-D output; normalisation {inside} the graph",
    )
