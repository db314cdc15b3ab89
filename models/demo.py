"""The demo model: a face embedding without training, built here as an ONNX graph.

It lets ``veilface demo`` and the tests run the whole service on a clone that has no weights. It
looks at the direction of edges around each place of the picture (a histogram of oriented
gradients, made independent of the light by the contrast around the place), takes off what the
picture has of a direction everywhere, projects the rest with fixed random signs to 256 numbers, and
takes off the mean of drawn faces. No weight is learnt, and nothing has seen a real face.

**Demo model: not for authentication.** On photos of real people it is little more than a
comparison of pictures.

It has no detector, because drawn faces come aligned. In its place :func:`require_face` holds a
picture against the mean of drawn faces, so that one of something else is refused as one without a
face.
"""

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from models.errors import NoFace
from models.synthetic import draw_people

DEMO_NOTICE = "demo model: not for authentication"
DEMO_DIMENSION = 256
DEMO_FILE = "demo.onnx"
_SIDE = 112
_DIRECTIONS = 4
_SIGMA = 1.2  # width of the edge filters in pixels
_REACH = 4
_CELL = 8  # an edge counts for all cells of 8 x 8 pixels that hold it; cells start every 4 pixels
_STRIDE = 4
_CELLS = (_SIDE - _CELL) // _STRIDE + 1
_FLAT = 9e-4  # squared contrast below which a cell is sensor noise: (0.03)^2 on a scale of -1 to 1
_CENTRE = (56.0, 62.0)  # of the window that keeps background and most hair out
_WINDOW = (30.0, 42.0)
_AVERAGED = range(10_000_000, 10_000_064)  # people whom no demo and no test enrolls
_LEAST_ALIKE = 0.31  # cosine to the mean; tests/models/test_demo.py measures both sides
_GRID = 1 / 4096  # constants are rounded to it, so that no bit depends on a machine's libm


def build_demo_pack(folder: Path) -> Path:
    """Write the demo model into ``folder``, which is returned, as a pack without a detector.

    The pack takes aligned 112 x 112 faces (:func:`models.synthetic.draw_face` draws them) with
    the usual ArcFace preprocessing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / DEMO_FILE).write_bytes(demo_model_bytes())
    return folder


@cache
def demo_model_bytes() -> bytes:
    """Build the ONNX file: the same bytes each time, since its SHA-256 stands in contracts."""
    return _model_without(_mean_projection())


def _model_without(mean: NDArray[np.float32]) -> bytes:
    cell, step, around = [_CELL] * 2, [_STRIDE] * 2, [3, 3]
    nodes = [
        _node("Conv", ["image", "edges"], "slopes", pads=[_REACH] * 4),
        # Which side of an edge is the darker one is an accident of hair and background.
        _node("Abs", ["slopes"], "steep"),
        _node("AveragePool", ["steep"], "cells", kernel_shape=cell, strides=step),
        _node("ReduceSumSquare", ["cells"], "energy", axes=[1]),
        _node("AveragePool", ["energy"], "around", kernel_shape=around, pads=[1] * 4),
        _node("Add", ["around", "flat"], "floored"),
        _node("Sqrt", ["floored"], "contrast"),
        _node("Div", ["cells", "contrast"], "features"),
        _node("GlobalAveragePool", ["features"], "everywhere"),
        _node("Sub", ["features", "everywhere"], "difference"),
        _node("Mul", ["difference", "window"], "seen"),
        _node("Flatten", ["seen"], "flattened"),
        _node("Cast", ["signs"], "directions", to=[_FLOAT]),
        _node("MatMul", ["flattened", "directions"], "projected"),
        _node("Sub", ["projected", "mean"], "embedding"),
    ]
    constants: dict[str, NDArray[np.generic]] = {
        "edges": _edge_filters(),
        "flat": np.asarray([_FLAT], np.float32),
        "window": _window(),
        "signs": _signs(_DIRECTIONS * _CELLS * _CELLS, DEMO_DIMENSION),
        "mean": mean,
    }
    return _model(nodes, constants)


@cache
def demo_model_sha256() -> str:
    """SHA-256 of :func:`demo_model_bytes` in hexadecimal."""
    return hashlib.sha256(demo_model_bytes()).hexdigest()


def is_demo_model(sha256: str) -> bool:
    """Whether an embedder's fingerprint is the demo model's: then show ``DEMO_NOTICE``."""
    return sha256.lower() == demo_model_sha256()


def require_face(crop: NDArray[np.uint8]) -> None:
    """Refuse what is no aligned face, by how alike its projection is to that of drawn faces."""
    projected, mean = _projections(crop[None])[0], _mean_projection()
    if projected @ mean < _LEAST_ALIKE * np.linalg.norm(projected) * np.linalg.norm(mean):
        raise NoFace(
            "no cartoon face was found, and the demo model sees no others: send one that the demo "
            "drew, upright and aligned"
        )


@cache
def _mean_projection() -> NDArray[np.float32]:
    """Mean projection of drawn people, (256,), rounded so that its bits are stable."""
    mean = _projections(draw_people(_AVERAGED, range(1), size=_SIDE)).mean(axis=0)
    return np.asarray(np.round(mean * 16) / 16, np.float32)


def _projections(crops: NDArray[np.uint8]) -> NDArray[np.float64]:
    """What the model gives of faces, (B, 256), before it takes off their mean."""
    images = ((crops.astype(np.float32) - 127.5) / 127.5).transpose(0, 3, 1, 2)
    rows = _session().run(None, {"image": np.ascontiguousarray(images)})[0]
    return np.asarray(rows, np.float64)


@cache
def _session() -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1  # the order of a sum must not depend on the number of cores
    model = _model_without(np.zeros(DEMO_DIMENSION, np.float32))
    return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _edge_filters() -> NDArray[np.float32]:
    """Slopes of the luminance by direction: (4, 3, 9, 9)."""
    reach = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    y, x = np.meshgrid(reach, reach, indexing="ij")
    bell = np.exp(-(x**2 + y**2) / (2 * _SIGMA**2))
    angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    slopes = (np.cos(angles)[:, None, None] * x + np.sin(angles)[:, None, None] * y) * bell
    slopes /= np.abs(slopes).sum(axis=(1, 2), keepdims=True)
    luminance = np.array([0.299, 0.587, 0.114])
    return _rounded(slopes[:, None] * luminance[None, :, None, None])


def _window() -> NDArray[np.float32]:
    """Weight of each cell, (27, 27): 1 on the face, falling fast beyond it."""
    middle = _CELL / 2 + _STRIDE * np.arange(_CELLS)
    across = np.abs((middle - _CENTRE[0]) / _WINDOW[0]) ** 4
    down = np.abs((middle - _CENTRE[1]) / _WINDOW[1]) ** 4
    return _rounded(np.sqrt(np.exp(-(across[None, :] + down[:, None]))))


def _signs(rows: int, columns: int) -> NDArray[np.int8]:
    """Signs from SHAKE-256: an almost orthogonal projection that anyone can recompute."""
    stream = hashlib.shake_256(b"veilface demo projection 1").digest((rows * columns + 7) // 8)
    bits = np.unpackbits(np.frombuffer(stream, np.uint8))[: rows * columns]
    return (bits.reshape(rows, columns).astype(np.int8) * 2 - 1).astype(np.int8)


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.asarray(np.round(values / _GRID) * _GRID, np.float32)


# The ONNX file: protobuf messages, written field by field. Numbers are those of onnx.proto.
_FLOAT, _INT8 = 1, 3


def _message(*fields: tuple[int, int | str | bytes]) -> bytes:
    """Write a message: whole numbers, strings, and bytes or messages, by field number."""
    written = b""
    for number, value in fields:
        if isinstance(value, int):
            written += _varint(number << 3) + _varint(value)
        else:
            data = value.encode() if isinstance(value, str) else value
            written += _varint(number << 3 | 2) + _varint(len(data)) + data
    return written


def _varint(value: int) -> bytes:
    low = bytearray()
    while value > 127:
        low.append(value & 127 | 128)
        value >>= 7
    return bytes([*low, value])


def _node(kind: str, inputs: list[str], output: str, **attributes: list[int]) -> bytes:
    """NodeProto: input 1, output 2, op_type 4, attribute 5 (name 1, i 3, ints 8, type 20)."""
    written = []
    for name, values in attributes.items():
        is_number = name == "to"
        numbers = [(3 if is_number else 8, value) for value in values]
        written.append((5, _message((1, name), *numbers, (20, 2 if is_number else 7))))
    return _message(*((1, name) for name in inputs), (2, output), (4, kind), *written)


def _constant(name: str, values: NDArray[np.generic]) -> bytes:
    """TensorProto: dims 1, data_type 2, name 8, raw_data 9."""
    kind = _INT8 if values.dtype == np.int8 else _FLOAT
    data = values.astype(values.dtype.newbyteorder("<")).tobytes()
    return _message(*((1, size) for size in values.shape), (2, kind), (8, name), (9, data))


def _value(name: str, *shape: int) -> bytes:
    """ValueInfoProto of float32: a name and a tensor's type, sizes by number (1) or name (2)."""
    sizes = [(1, _message((2, "N"))), *((1, _message((1, size))) for size in shape)]
    tensor = _message((1, _FLOAT), (2, _message(*sizes)))
    return _message((1, name), (2, _message((1, tensor))))


def _model(nodes: list[bytes], constants: Mapping[str, NDArray[np.generic]]) -> bytes:
    """ModelProto: ir_version 1, producer 2, doc_string 6, graph 7, opset 8, metadata 14."""
    graph = _message(
        *((1, node) for node in nodes),
        (2, "veilface-demo"),
        *((5, _constant(name, values)) for name, values in constants.items()),
        (11, _value("image", 3, _SIDE, _SIDE)),
        (12, _value("embedding", DEMO_DIMENSION)),
    )
    opset, notice = _message((1, ""), (2, 17)), _message((1, "notice"), (2, DEMO_NOTICE))
    head = _message((1, 8), (2, "veilface"), (6, DEMO_NOTICE))
    return head + _message((7, graph), (8, opset), (14, notice))
