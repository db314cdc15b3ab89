"""How live a face looks: graphs of passive presentation attack detection, run on the whole frame.

They see more than the aligned crop: the edge of a sheet or a screen lies around the face. What
they cannot see is said in docs/liveness.md.
"""

import hashlib
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError, PackError
from models.pack_file import CropShape, LivenessStatement, PackFile
from models.pack_graphs import PackGraph, image_size

Box = tuple[float, float, float, float]
Region = tuple[int, int, int, int]

# A square crop is made with at most this many times the pixels of the input's side.
_FINER = 4
# How far MiniFASNet's crop reaches is in no graph, but in the name that its authors give the file:
# "2.7_80x80_MiniFASNetV2", "4_0_0_80x80_MiniFASNetV1SE", "minifasnet_v1se_4.0_80x80".
_SCALE_IN_NAME = re.compile(r"(?:^|[_-])(\d(?:\.\d+)?)(?:_0_0)?_80x80(?![0-9x])")


class LivenessGraph:
    """One graph of passive presentation attack detection.

    Raises
    ------
    PackError
        If its input is unknown, or its output does not have the live class.
    """

    def __init__(self, graph: PackGraph, stated: LivenessStatement) -> None:
        size, width = image_size(graph.session.inputs) or (None, None)
        if size is None or size != width:
            raise PackError(
                f"{graph.path} takes {width or 'any'} x {size or 'any'} pixels; a liveness graph"
                " takes a square of a fixed size."
            )
        in_name = _SCALE_IN_NAME.search(graph.path.stem)
        crop_scale = stated.crop_scale or (float(in_name[1]) if in_name else None)
        if crop_scale is None:
            raise PackError(
                f"{graph.path} is a liveness graph, and nothing says how far around the face it"
                " looks: state crop_scale in pack.toml, under [[liveness]], or give the file back"
                " the name that its authors gave it, such as 2.7_80x80_MiniFASNetV2.onnx."
            )
        self.file, self.sha256 = graph.file, graph.sha256
        self.crop_scale, self.size, self.stated = crop_scale, size, stated
        self._session = graph.session
        noise = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
        try:
            outputs = [self._output(crop) for crop in (np.zeros_like(noise), noise)]
        except ModelError as error:
            raise PackError(f"{graph.path}, as a liveness graph: {error}") from error
        classes = outputs[0].size
        if stated.live_class >= classes or classes < 2:
            raise PackError(
                f"{graph.path} tells {classes} classes apart; live_class {stated.live_class} is"
                " none of them. Correct it in pack.toml."
            )
        # A softmax of its own: logits do not add up to 1 for any picture.
        self._is_normalised = all(
            output.min() >= 0 and abs(output.sum() - 1) < 1e-4 for output in outputs
        )

    @property
    def graph_id(self) -> str:
        """SHA-256 of the file's hash and of what the graph is fed.

        A threshold belongs to both: another crop gives other scores.
        """
        facts = {name: value for name, value in self.as_dict().items() if name != "file"}
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def as_dict(self) -> dict[str, Any]:
        """File, its hash, and what the graph is fed, as JSON values."""
        return {
            **self.stated.model_dump(mode="json"),
            "file": self.file,
            "sha256": self.sha256,
            "crop_scale": self.crop_scale,
            "input_size": self.size,
        }

    def score(self, picture: NDArray[np.uint8], box: Box) -> float:
        """Return how live the face in ``box`` looks to this graph alone, 0...1."""
        crop = crop_face(
            picture, box, shape=self.stated.crop, scale=self.crop_scale, size=self.size
        )
        shares = self._output(crop)
        if not self._is_normalised:
            shares = np.exp(shares - shares.max())
            shares /= shares.sum()
        return float(shares[self.stated.live_class])

    def _output(self, crop: NDArray[np.uint8]) -> NDArray[np.float64]:
        ordered = crop[..., ::-1] if self.stated.channel_order == "bgr" else crop
        low, high = self.stated.input_range
        values = ordered.astype(np.float32) * np.float32((high - low) / 255) + np.float32(low)
        blob = np.ascontiguousarray(values.transpose(2, 0, 1)[None])
        output = self._session.run({self._session.inputs[0].name: blob})[0]
        if output.ndim != 2 or len(output) != 1 or not np.isfinite(output).all():
            raise ModelError(
                f"{self.file}: one crop must give one row of finite numbers; got shape"
                f" {output.shape}."
            )
        return np.asarray(output[0], dtype=np.float64)


class PassiveLiveness:
    """The liveness graphs of a pack. Safe from several threads at once."""

    def __init__(self, graphs: Sequence[LivenessGraph]) -> None:
        self.members = tuple(graphs)

    @property
    def graphs(self) -> tuple[str, ...]:
        """Ids of the graphs, sorted: what a threshold belongs to (`LivenessGraph.graph_id`)."""
        return tuple(sorted(graph.graph_id for graph in self.members))

    def score(self, picture: NDArray[np.uint8], box: Box) -> float:
        """Return how live the face in a box of the whole upright frame looks, 0...1.

        The mean over the graphs of the share that each gives the live class.
        """
        return sum(graph.score(picture, box) for graph in self.members) / len(self.members)


def open_liveness(
    graphs: Sequence[PackGraph], stated: PackFile, folder: Path, *, detects: bool
) -> PassiveLiveness | None:
    """Make the liveness graphs of a pack ready; None where there is none."""
    for statement in stated.liveness:
        if not (folder / statement.file).is_file():
            raise PackError(
                f"pack.toml states the liveness graph {statement.file}; {folder} has none."
            )
    if not graphs:
        return None
    if not detects:
        raise PackError(
            f"{folder} has a liveness graph and no detector; liveness is seen on the whole frame:"
            " add a SCRFD or YuNet .onnx file, or remove the liveness graph."
        )
    try:
        return PassiveLiveness(
            [
                LivenessGraph(
                    graph, stated.liveness_of(graph.file) or LivenessStatement(file=graph.file)
                )
                for graph in graphs
            ]
        )
    except PackError as error:
        raise PackError(f"{error} Or remove the file.") from error


def crop_face(
    picture: NDArray[np.uint8], box: Box, *, shape: CropShape, scale: float, size: int
) -> NDArray[np.uint8]:
    """Cut a face with its surroundings, (size, size, 3), as the graph was trained."""
    height, width = picture.shape[:2]
    x1, y1, x2, y2 = box
    inside = min(x2, width) > max(x1, 0) and min(y2, height) > max(y1, 0)
    if not (all(map(math.isfinite, box)) and inside):
        raise ModelError("The box of a face has no area inside the frame.")
    if shape == "square":
        return _square_crop(picture, box, scale, size)
    left, top, right, bottom = box_region((width, height), box, scale)
    return _resized(picture[top:bottom, left:right], size, size)


def box_region(frame: tuple[int, int], box: Box, scale: float) -> Region:
    """Grow a box about its centre, no larger than the frame, and move it into the frame.

    This is how minivision's Silent-Face-Anti-Spoofing cuts the crops that MiniFASNet is trained
    on: near a border the face is off the middle of the crop, and nothing is padded.
    """
    sides = (box[2] - box[0], box[3] - box[1])
    fitting = min(scale, *((length - 1) / side for length, side in zip(frame, sides, strict=True)))
    first, last = [], []
    for axis, length in enumerate(frame):
        reach = sides[axis] * fitting
        start = (box[axis] + box[axis + 2] - reach) / 2
        start = min(max(start, 0.0), length - 1 - reach)
        first.append(max(0, int(start)))
        last.append(min(length, int(start + reach) + 1))
    return first[0], first[1], last[0], last[1]


def square_region(box: Box, scale: float) -> tuple[int, int, int]:
    """Left, top and side of the square about a box whose side is the longer one times the scale.

    It may reach over the border of the frame.
    """
    side = max(1, int(max(box[2] - box[0], box[3] - box[1]) * scale))
    left = math.floor((box[0] + box[2] - side) / 2)
    top = math.floor((box[1] + box[3] - side) / 2)
    return left, top, side


def _square_crop(
    picture: NDArray[np.uint8], box: Box, scale: float, size: int
) -> NDArray[np.uint8]:
    """Cut `square_region`; where it reaches over the border the frame is mirrored.

    What is in the frame of such a square is reduced before, so that memory does not depend on how
    far the square reaches.
    """
    left, top, side = square_region(box, scale)
    finer = min(side, _FINER * size)
    first, last, before, shown = [], [], [], []
    for start, length in zip((top, left), picture.shape, strict=False):
        first.append(max(start, 0))
        last.append(min(start + side, length))
        before.append(min(finer - 1, round(finer * (first[-1] - start) / side)))
        shown.append(max(1, finer - before[-1] - round(finer * (start + side - last[-1]) / side)))
    square = picture[first[0] : last[0], first[1] : last[1]]
    if square.shape[:2] != (side, side):
        if finer < side:
            square = _resized(square, shown[1], shown[0], cv2.INTER_AREA)
        after = [finer - margin - inside for margin, inside in zip(before, shown, strict=True)]
        borders = (before[0], after[0], before[1], after[1])
        square = np.asarray(
            cv2.copyMakeBorder(square, *borders, cv2.BORDER_REFLECT_101), dtype=np.uint8
        )
    kind = cv2.INTER_AREA if side > size else cv2.INTER_LANCZOS4
    return _resized(square, size, size, kind)


def _resized(
    picture: NDArray[np.uint8], width: int, height: int, kind: int = cv2.INTER_LINEAR
) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(picture, (width, height), interpolation=kind), dtype=np.uint8)
