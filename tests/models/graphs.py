"""Small ONNX graphs whose results a test can compute on its own."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

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
    """A graph of the given signature that gives zeros, whatever it is fed."""
    zeros = [
        numpy_helper.from_array(
            np.zeros([size if isinstance(size, int) else 1 for size in shape], np.float32),
            f"zeros_{name}",
        )
        for name, shape in outputs
    ]
    graph = helper.make_graph(
        [helper.make_node("Identity", [f"zeros_{name}"], [name]) for name, _ in outputs],
        "shaped",
        [_value(name, shape) for name, shape in inputs],
        [_value(name, shape) for name, shape in outputs],
        zeros,
    )
    return _save(graph)


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


def mean_liveness(weights: np.ndarray, *, size: Dim = 80, softmax: bool = False) -> bytes:
    """A liveness graph: logits are the means of the crop's channels times ``weights``, (3, k)."""
    classes = weights.shape[1]
    nodes = [
        helper.make_node("GlobalAveragePool", ["input"], ["pooled"]),
        helper.make_node("Flatten", ["pooled"], ["means"]),
        helper.make_node("MatMul", ["means", "weights"], ["logits" if softmax else "output"]),
    ]
    if softmax:
        nodes.append(helper.make_node("Softmax", ["logits"], ["output"], axis=1))
    graph = helper.make_graph(
        nodes,
        "liveness",
        [_value("input", ["N", 3, size, size])],
        [_value("output", ["N", classes])],
        [helper.make_tensor("weights", TensorProto.FLOAT, [3, classes], weights.ravel())],
    )
    return _save(graph)


def fixed_face_detector(box: Sequence[float], keypoints: np.ndarray, *, canvas: int = 128) -> bytes:
    """A YuNet that sees one face, always the same, in every picture that is not black."""
    widths = {"cls": 1, "obj": 1, "bbox": 4, "kps": 10}
    values = {
        f"{name}_{stride}": np.zeros((1, (canvas // stride) ** 2, width), np.float32)
        for name, width in widths.items()
        for stride in (8, 16, 32)
    }
    # Of the first cell, whose corner is the origin.
    x1, y1, x2, y2 = box
    values["cls_32"][0, 0] = values["obj_32"][0, 0] = 1
    values["bbox_32"][0, 0, :2] = (x1 + x2) / 64, (y1 + y2) / 64
    values["bbox_32"][0, 0, 2:] = np.log([(x2 - x1) / 32, (y2 - y1) / 32])
    values["kps_32"][0, 0] = (keypoints / 32).ravel()
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMax", ["input"], ["brightest"], keepdims=0),
            helper.make_node("Min", ["brightest", "one"], ["light"]),
            *(helper.make_node("Mul", [f"made_{name}", "light"], [name]) for name in values),
        ],
        "fixed-face",
        [_value("input", [1, 3, canvas, canvas])],
        [_value(name, made.shape) for name, made in values.items()],
        [
            helper.make_tensor("one", TensorProto.FLOAT, [], [1.0]),
            *(numpy_helper.from_array(made, f"made_{name}") for name, made in values.items()),
        ],
    )
    return _save(graph)


def linked_pack(folder: Path, pack: Path, toml: str) -> Path:
    """A pack's graphs in a writable folder, with a ``pack.toml``."""
    for file in pack.glob("*.onnx"):
        (folder / file.name).symlink_to(file)
    (folder / "pack.toml").write_text(toml)
    return folder


def write_pack(folder: Path, **files: bytes) -> Path:
    """A pack folder with ``name=bytes`` written to ``name.onnx``."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / f"{name}.onnx").write_bytes(content)
    return folder
