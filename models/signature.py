"""What an ONNX graph is, told from its inputs, outputs and first nodes; never from its name."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from models import onnx_file
from models.errors import PackError
from models.onnx_file import Attribute, Graph, Message, Model, Node
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
    LIVENESS = "liveness"
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
    """The part of a graph that routing looks at; ``output_node`` makes the first output."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    first_nodes: tuple[str, ...]
    output_node: str

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
        return _signature(Message(model), name)
    except ValueError:
        raise PackError(f"{name} is not a readable ONNX model; fetch the file again.") from None


def _signature(model: Message, name: str) -> Signature:
    graphs = model.messages(Model.GRAPH)
    if len(graphs) != 1 or not (nodes := graphs[0].messages(Graph.NODE)):
        raise PackError(f"{name} is not a readable ONNX model: its graph is empty.")
    graph = graphs[0]
    if any(
        tensor.number(onnx_file.Tensor.DATA_LOCATION) == onnx_file.EXTERNAL
        for tensor in _tensors(model)
    ):
        raise PackError(
            f"{name} keeps its weights in another file; convert it to a single .onnx file, so"
            " that its hash covers the weights."
        )
    # Up to IR version 3 the weights were listed among the inputs as well.
    weights = {weight.text(onnx_file.Tensor.NAME) for weight in graph.messages(Graph.INITIALIZER)}
    inputs = map(_tensor, graph.messages(Graph.INPUT))
    return Signature(
        inputs=tuple(tensor for tensor in inputs if tensor.name not in weights),
        outputs=tuple(map(_tensor, graph.messages(Graph.OUTPUT))),
        first_nodes=tuple(node.text(Node.OP_TYPE) for node in nodes[:FIRST_NODES]),
        output_node=_output_node(graph, nodes),
    )


def _output_node(graph: Message, nodes: list[Message]) -> str:
    outputs = graph.messages(Graph.OUTPUT)
    # A value's name is field 1. A node's text is that of its last output; those that end a graph
    # of one output have one.
    name = outputs[0].text(1) if outputs else ""
    return next((n.text(Node.OP_TYPE) for n in nodes if n.text(Node.OUTPUT) == name), "")


def _tensors(model: Message) -> Iterator[Message]:
    """Every tensor of a model: weights, constants of nodes, those of nested graphs."""
    graphs = model.messages(Model.GRAPH)
    nodes = model.messages(Model.FUNCTIONS, onnx_file.FUNCTION_NODE)
    while graphs or nodes:
        if graphs:
            graph = graphs.pop()
            yield from graph.messages(Graph.INITIALIZER)
            # Values and indices of sparse weights.
            yield from graph.messages(Graph.SPARSE_INITIALIZER, 1)
            yield from graph.messages(Graph.SPARSE_INITIALIZER, 2)
            nodes.extend(graph.messages(Graph.NODE))
            continue
        for attribute in nodes.pop().messages(Node.ATTRIBUTE):
            yield from attribute.messages(Attribute.TENSOR)
            yield from attribute.messages(Attribute.TENSORS)
            graphs += attribute.messages(Attribute.GRAPH) + attribute.messages(Attribute.GRAPHS)


def _tensor(value: Message) -> Tensor:
    # A value's type (2) is a tensor's (1), whose shape (2) has dimensions (1) with a size (1).
    return Tensor(
        name=value.text(1),
        shape=tuple(dim.number(1) for dim in value.messages(2, 1, 2, 1)),
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
    if size == (80, 80) and values == [3]:
        return Role.LIVENESS, "80 x 80 input and 3 output values (MiniFASNet)"
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
    if signature.outputs[0].shape[1] in (2, 3):
        return (
            Role.UNKNOWN,
            f"{signature.outputs[0].shape[1]} output values are no embedding; a liveness graph is"
            " stated in pack.toml, under [[liveness]]",
        )
    inside = "inside" if signature.normalises else "outside"
    return (
        Role.EMBEDDER,
        f"square {width} x {height} input and one 2-D output; normalisation {inside} the graph",
    )
