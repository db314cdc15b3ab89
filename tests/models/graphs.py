"""Small ONNX graphs whose results a test can compute on its own."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper

Dim = int | str
POOL = 16


def _value(name: str, shape: Sequence[Dim]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape))


def _save(graph: onnx.GraphProto) -> bytes:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def pooling_embedder(
    size: Dim = 112, *, batch: Dim = "N", inside: bool = False, factor: float = 1.0
) -> bytes:
    """Mean of every 16 x 16 block and channel; with ``inside`` the graph normalises itself."""
    nodes, current = [], "image"
    constants = [
        helper.make_tensor("mean", TensorProto.FLOAT, [], [127.5]),
        helper.make_tensor("inverse", TensorProto.FLOAT, [], [1 / 127.5]),
        helper.make_tensor("factor", TensorProto.FLOAT, [], [factor]),
    ]
    if inside:
        nodes += [
            helper.make_node("Sub", ["image", "mean"], ["centred"]),
            helper.make_node("Mul", ["centred", "inverse"], ["scaled"]),
        ]
        current = "scaled"
    nodes += [
        helper.make_node(
            "AveragePool", [current], ["pooled"], kernel_shape=[POOL, POOL], strides=[POOL, POOL]
        ),
        helper.make_node("Flatten", ["pooled"], ["flat"]),
        helper.make_node("Mul", ["flat", "factor"], ["embedding"]),
    ]
    n: Dim = 3 * (size // POOL) ** 2 if isinstance(size, int) else "n"
    graph = helper.make_graph(
        nodes,
        "pooling",
        [_value("image", [batch, 3, size, size])],
        [_value("embedding", [batch, n])],
        constants,
    )
    return _save(graph)


def pooled(crops: NDArray[np.uint8]) -> NDArray[np.float64]:
    """What `pooling_embedder` computes on ``(x - 127.5) / 127.5``, before the L2 norm."""
    x = (crops.astype(np.float64) - 127.5) / 127.5
    count, size = x.shape[0], x.shape[1] // POOL
    blocks = x.reshape(count, size, POOL, size, POOL, 3).mean(axis=(2, 4))
    return blocks.transpose(0, 3, 1, 2).reshape(count, -1)


def unit(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def shaped(
    inputs: Sequence[tuple[str, Sequence[Dim]]], outputs: Sequence[tuple[str, Sequence[Dim]]]
) -> bytes:
    """A graph of the given signature that only ever says what its first input is."""
    nodes = [helper.make_node("Identity", [inputs[0][0]], [name]) for name, _ in outputs]
    graph = helper.make_graph(
        nodes,
        "shaped",
        [_value(name, shape) for name, shape in inputs],
        [_value(name, shape) for name, shape in outputs],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


def scrfd_shapes(*, keypoints: bool = True, batched: bool = False) -> bytes:
    cells = (12800, 3200, 800)
    widths = (1, 4, 10) if keypoints else (1, 4)
    lead = [1] if batched else []
    outputs = [(f"o{w}_{c}", [*lead, c, w]) for w in widths for c in cells]
    return shaped([("input.1", [1, 3, "?", "?"])], outputs)


def yunet_shapes() -> bytes:
    outputs = [
        (f"{role}_{stride}", ["b", "cells", width])
        for role, width in (("cls", 1), ("obj", 1), ("bbox", 4), ("kps", 10))
        for stride in (8, 16, 32)
    ]
    return shaped([("input", [1, 3, 640, 640])], outputs)


def write_pack(folder: Path, **files: bytes) -> Path:
    """A pack folder with ``name=bytes`` written to ``name.onnx``."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / f"{name}.onnx").write_bytes(content)
    return folder
