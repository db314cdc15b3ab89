"""Pictures of heads whose five points are marked by colours, and a pack whose detector sees marks.

The detector is a graph in SCRFD's form that returns the middle of each colour, so whatever moves
the marks, a scaled or compressed picture too, moves the points that the service sees.
"""

import functools
import io
from pathlib import Path

import cv2
import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from models.alignment import template
from tests.api.deployment import write_pack
from tests.heads import POSES, SIZE, Points, head

# Left eye, right eye, nose, left and right mouth corner.
MARKS = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (0, 255, 255))
_CELLS = {8: 12800, 16: 3200, 32: 800}
_LEAST = 0.4
# On the template, where eyes and mouth lie about the nose.
_NOSE_RADIUS = 45.0


def pattern(person: int) -> NDArray[np.uint8]:
    """Grey clouds, in which a person differs from others, and squares as details, 112 x 112."""
    rng = np.random.default_rng([17, person])
    clouds = rng.integers(0, 256, (3, 3)).astype(np.float32)
    clouds = cv2.resize(clouds, (112, 112), interpolation=cv2.INTER_CUBIC)
    squares = np.kron(rng.integers(0, 256, (14, 14)), np.ones((8, 8)))
    return np.clip(0.8 * clouds + 0.2 * squares, 0, 255).astype(np.uint8)


def draw(
    points: Points,
    person: int = 0,
    *,
    marked: bool = True,
    background: int = 120,
    face: Points | None = None,
) -> NDArray[np.uint8]:
    """A picture, RGB, of a person whose five points are there, before a grey wall.

    With `face`, only the marks are at the points, and the face is where those of `face` are, as
    where a card before a face moves what a detector sees.
    """
    own = points if face is None else face
    outline = [0, 1, 3, 4]
    flat = cv2.getPerspectiveTransform(
        own[outline].astype(np.float32), template(112)[outline].astype(np.float32)
    )
    place = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).astype(np.float64)
    place = cv2.perspectiveTransform(place, flat)
    nose = cv2.perspectiveTransform(own[None, 2:3].astype(np.float64), flat)[0, 0]
    # The nose stands out of the plane of eyes and mouth, and the sides of a head lie behind it.
    relief = 1 - np.square(place - nose).sum(axis=2, keepdims=True) / _NOSE_RADIUS**2
    place -= np.maximum(relief, -2.5) * (nose - template(112)[2])
    grey = cv2.remap(
        pattern(person),
        place.astype(np.float32),
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(background,),
    )
    picture = np.ascontiguousarray(np.repeat(np.asarray(grey)[:, :, None], 3, axis=2))
    if marked:
        for colour, point in zip(MARKS, np.round(points * 16).astype(int), strict=True):
            x, y = (int(value) for value in point)
            cv2.circle(picture, (x, y), 5 * 16, colour, -1, cv2.LINE_AA, 4)
    return np.asarray(picture, np.uint8)


def encoded(picture: NDArray[np.uint8], form: str = "PNG") -> bytes:
    """A picture as a file."""
    out = io.BytesIO()
    Image.fromarray(picture).save(out, form, quality=92)
    return out.getvalue()


@functools.cache
def frame(pose: str = "front", person: int = 0, background: int = 120) -> bytes:
    """A file that shows a person in one of the poses of :data:`tests.heads.POSES`."""
    return encoded(draw(head(**POSES[pose]), person, background=background))


def write_marked_pack(folder: Path) -> Path:
    """The tiny embedder of the test deployment, and the detector of marks."""
    write_pack(folder)
    onnx.save(_detector(), folder / "marks.onnx")
    return folder


def _detector() -> onnx.ModelProto:
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    constants: dict[str, NDArray[np.generic]] = {
        "x": x[None, None],
        "y": y[None, None],
        "scale": np.array([128 / 255], np.float32),
        "half": np.array([0.5], np.float32),
        "least": np.array([_LEAST], np.float32),
        "tiny": np.array([1e-6], np.float32),
        "one": np.ones(1, np.float32),
        "stride": np.array([8], np.float32),
        "reach": np.array([0.6], np.float32),
        "zero": np.zeros((), np.float32),
        "ninety": np.array(0.99, np.float32),
        "axes": np.array([2, 3], np.int64),
        "none_1": np.zeros((_CELLS[8] - 1, 1), np.float32),
        "none_4": np.zeros((_CELLS[8] - 1, 4), np.float32),
        "none_10": np.zeros((_CELLS[8] - 1, 10), np.float32),
    }
    for stride in (16, 32):
        for width in (1, 4, 10):
            constants[f"empty_{width}_{stride}"] = np.zeros((_CELLS[stride], width), np.float32)
    nodes = [
        helper.make_node("Mul", ["input.1", "scale"], ["scaled"]),
        helper.make_node("Add", ["scaled", "half"], ["rgb"]),
        helper.make_node("Split", ["rgb"], ["R", "G", "B"], axis=1, num_outputs=3),
    ]

    def node(kind: str, inputs: list[str], output: str, **options: object) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], **options))
        return output

    # How much more of its own channels than of the others a pixel has.
    channels = "RGB"
    xs, ys, sums = [], [], []
    for number, colour in enumerate(MARKS):
        own = [name for name, value in zip(channels, colour, strict=True) if value]
        others = [name for name in channels if name not in own]
        low, high = node("Min", own, f"own_{number}"), node("Max", others, f"others_{number}")
        excess = node("Sub", [low, high], f"excess_{number}")
        mask = node("Relu", [node("Sub", [excess, "least"], f"over_{number}")], f"mask_{number}")
        total = node("ReduceSum", [mask, "axes"], f"sum_{number}", keepdims=0)
        safe = node("Add", [total, "tiny"], f"safe_{number}")
        for axis, places in (("x", xs), ("y", ys)):
            weighted = node("Mul", [mask, axis], f"{axis}_weighted_{number}")
            moment = node("ReduceSum", [weighted, "axes"], f"{axis}_moment_{number}", keepdims=0)
            places.append(node("Div", [moment, safe], f"{axis}_{number}"))
        sums.append(total)
    seen = node("Sub", [node("Min", sums, "fewest"), "one"], "seen")
    score = node("Clip", [seen, "zero", "ninety"], "score")
    both = [place for pair in zip(xs, ys, strict=True) for place in pair]
    points = node("Div", [node("Concat", both, "places", axis=1), "stride"], "points")
    sides = []
    for axis, places in (("x", xs), ("y", ys)):
        first, last = node("Min", places, f"{axis}_first"), node("Max", places, f"{axis}_last")
        spread = node("Sub", [last, first], f"{axis}_spread")
        margin = node("Mul", [spread, "reach"], f"{axis}_margin")
        low = node("Neg", [node("Sub", [first, margin], f"{axis}_low")], f"{axis}_before")
        sides.append((low, node("Add", [last, margin], f"{axis}_after")))
    order = [sides[0][0], sides[1][0], sides[0][1], sides[1][1]]
    box = node("Div", [node("Concat", order, "sides", axis=1), "stride"], "box")
    for width, first in ((1, score), (4, box), (10, points)):
        node("Concat", [first, f"none_{width}"], f"o{width}_8", axis=0)
        for stride in (16, 32):
            node("Identity", [f"empty_{width}_{stride}"], f"o{width}_{stride}")
    graph = helper.make_graph(
        nodes,
        "marks",
        [helper.make_tensor_value_info("input.1", TensorProto.FLOAT, [1, 3, SIZE, SIZE])],
        [
            helper.make_tensor_value_info(
                f"o{width}_{stride}", TensorProto.FLOAT, [_CELLS[stride], width]
            )
            for width in (1, 4, 10)
            for stride in _CELLS
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    onnx.checker.check_model(model)
    return model


def add_liveness(pack: Path) -> Path:
    """Add a graph to which a face before a black wall is not live, and before a grey one is."""
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1, 2, 3], keepdims=0),
            helper.make_node("Reshape", ["mean", "column"], ["one"]),
            helper.make_node("MatMul", ["one", "weights"], ["weighted"]),
            helper.make_node("Add", ["weighted", "offset"], ["logits"]),
        ],
        "light",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 80, 80])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 2])],
        [
            numpy_helper.from_array(np.array([1, 1], np.int64), "column"),
            numpy_helper.from_array(np.array([[10, -10]], np.float32), "weights"),
            # A brightness of 0.35 is on the border.
            numpy_helper.from_array(np.array([[-3.5, 3.5]], np.float32), "offset"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, pack / "light.onnx")
    (pack / "pack.toml").write_text(
        '[[liveness]]\nfile = "light.onnx"\ncrop_scale = 2.7\ncrop = "square"\n'
        'channel_order = "rgb"\ninput_range = [0, 1]\nlive_class = 0\n'
    )
    return pack
