"""How live a face looks: graphs of passive presentation attack detection, run on the whole frame.

They see more than the aligned crop: the edge of a sheet or a screen lies around the face. What
they cannot see is said in docs/liveness.md.
"""

import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError, PackError
from models.pack_file import LivenessStatement, PackFile
from models.pack_graphs import PackGraph, image_size
from models.sessions import Session

Box = tuple[float, float, float, float]
Region = tuple[int, int, int, int]
CropShape = Literal["box", "square"]
ScoreKind = Literal["softmax", "difference"]

# A square is mirrored at this many times the input's resolution, or the frame's own.
_FINER = 4
# How far MiniFASNet's crop reaches is in no graph, but in the name that its authors give the file:
# "2.7_80x80_MiniFASNetV2", "4_0_0_80x80_MiniFASNetV1SE", "minifasnet_v1se_4.0_80x80".
_SCALE_IN_NAME = re.compile(r"(?:^|[_-])(\d(?:\.\d+)?)(?:_0_0)?_80x80(?![0-9x])")


@dataclass(frozen=True, kw_only=True)
class LivenessInput:
    """What a liveness graph is fed, and how its output is read."""

    crop_scale: float  # sides of the crop over those of the face's box
    # box keeps the box's shape, is limited to the frame's size and moved into it; square has the
    # longer side, and mirrors the frame where it reaches over the border.
    crop: CropShape
    size: int  # side of the square input in pixels
    channel_order: str  # rgb or bgr
    input_range: tuple[float, float]  # what the pixel values 0 and 255 become
    live_class: int  # place among the outputs, from 0
    # softmax: share of the live class, 0…1; difference: of two logits, live less attack.
    score: ScoreKind


class LivenessGraph:
    """One graph of passive presentation attack detection."""

    def __init__(self, session: Session, *, sha256: str, expects: LivenessInput) -> None:
        self._session = session
        self.expects = expects
        self.file = session.name
        self.sha256 = sha256
        size = (expects.size, expects.size, 3)
        noise = np.random.default_rng(0).integers(0, 256, size, dtype=np.uint8)
        outputs = [self._output(picture) for picture in (np.zeros(size, np.uint8), noise)]
        # A softmax of its own: logits do not add up to 1 for any picture.
        self._is_normalised = all(
            output.min() >= 0 and abs(output.sum() - 1) < 1e-4 for output in outputs
        )
        classes = outputs[0].size
        if expects.live_class >= classes or classes < 2:
            raise ModelError(
                f"{self.file} tells {classes} classes apart; live_class {expects.live_class} is"
                " none of them. Correct it in pack.toml."
            )
        if expects.score == "difference" and (classes != 2 or self._is_normalised):
            raise ModelError(
                f'{self.file} does not end in two logits: the score "difference" has no meaning;'
                ' state "softmax" in pack.toml.'
            )

    @property
    def graph_id(self) -> str:
        """SHA-256 of the file's hash and of what the graph is fed.

        A threshold belongs to both: another crop gives other scores.
        """
        stated = {"sha256": self.sha256, **asdict(self.expects)}
        return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()

    def as_dict(self) -> dict[str, Any]:
        """JSON-able form."""
        return {
            "file": self.file,
            "sha256": self.sha256,
            "graph_id": self.graph_id,
            **asdict(self.expects),
            "input_range": list(self.expects.input_range),
        }

    def score(self, picture: NDArray[np.uint8], box: Box) -> float:
        """Return how live the face in ``box`` looks to this graph alone."""
        output = self._output(crop_face(picture, box, self.expects))
        live = self.expects.live_class
        if self.expects.score == "difference":
            return float(output[live] - output[1 - live])
        if self._is_normalised:
            return float(output[live])
        shares = np.exp(output - output.max())
        return float(shares[live] / shares.sum())

    def _output(self, crop: NDArray[np.uint8]) -> NDArray[np.float64]:
        expects = self.expects
        ordered = crop[..., ::-1] if expects.channel_order == "bgr" else crop
        low, high = expects.input_range
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
        kinds = {graph.expects.score for graph in graphs}
        if len(kinds) != 1:
            names = ", ".join(f"{graph.file} ({graph.expects.score})" for graph in graphs)
            raise ModelError(
                f"The liveness graphs score in different units: {names}. State one score for all"
                " of them in pack.toml, or leave one kind in the folder."
            )
        self.members = tuple(graphs)

    @property
    def graphs(self) -> tuple[str, ...]:
        """Ids of the graphs, sorted: what a threshold belongs to (`LivenessGraph.graph_id`)."""
        return tuple(sorted(graph.graph_id for graph in self.members))

    def score(self, picture: NDArray[np.uint8], box: Box) -> float:
        """Return how live the face in a box of the whole upright frame looks; higher is more live.

        The mean over the graphs: in 0…1, or a difference of logits.
        """
        return sum(graph.score(picture, box) for graph in self.members) / len(self.members)


def open_liveness(
    graphs: Sequence[PackGraph], stated: PackFile, folder: Path, *, detects: bool
) -> PassiveLiveness | None:
    """Make the liveness graphs of a pack ready; None where there is none."""
    for stated_graph in stated.liveness:
        if not (folder / stated_graph.file).is_file():
            raise PackError(
                f"pack.toml states the liveness graph {stated_graph.file}; {folder} has none."
            )
    if graphs and not detects:
        raise PackError(
            f"{folder} has a liveness graph and no detector; liveness is seen on the whole frame:"
            " add a SCRFD or YuNet .onnx file."
        )
    members = []
    for graph in graphs:
        expects = expected_input(graph, stated.liveness_of(graph.file))
        try:
            members.append(LivenessGraph(graph.session, sha256=graph.sha256, expects=expects))
        except ModelError as error:
            raise PackError(f"{graph.path}, as a liveness graph: {error}") from error
    try:
        return PassiveLiveness(members) if members else None
    except ModelError as error:
        raise PackError(f"{folder}: {error}") from error


def expected_input(graph: PackGraph, statement: LivenessStatement | None) -> LivenessInput:
    """What a graph is fed: as stated, else as MiniFASNet is."""
    stated = statement or LivenessStatement(file=graph.file)
    height, width = image_size(graph.session.inputs) or (None, None)
    size = height or stated.input_size
    if height != width or size is None or stated.input_size not in (None, size):
        raise PackError(
            f"{graph.path} takes {width or 'any'} x {height or 'any'} pixels; a liveness graph"
            f" takes a square, and input_size in pack.toml states the side where it is open."
        )
    in_name = _SCALE_IN_NAME.search(graph.path.stem)
    scale = stated.crop_scale or (float(in_name[1]) if in_name else None)
    if scale is None:
        raise PackError(
            f"{graph.path} is a liveness graph, and nothing says how far around the face it looks:"
            " state crop_scale in pack.toml, under [[liveness]], or give the file back the name"
            " that its authors gave it, such as 2.7_80x80_MiniFASNetV2.onnx."
        )
    return LivenessInput(
        crop_scale=scale,
        crop=stated.crop or "box",
        size=size,
        channel_order=stated.channel_order or "bgr",
        input_range=stated.input_range or (0.0, 255.0),
        live_class=1 if stated.live_class is None else stated.live_class,
        score=stated.score or "softmax",
    )


def crop_face(picture: NDArray[np.uint8], box: Box, expects: LivenessInput) -> NDArray[np.uint8]:
    """Cut a face with its surroundings, (size, size, 3), as the graph was trained."""
    height, width = picture.shape[:2]
    x1, y1, x2, y2 = box
    inside = min(x2, width) > max(x1, 0) and min(y2, height) > max(y1, 0)
    if not (all(map(math.isfinite, box)) and inside):
        raise ModelError("The box of a face has no area inside the frame.")
    if expects.crop == "box":
        left, top, right, bottom = box_region((width, height), box, expects.crop_scale)
        return _resized(picture[top:bottom, left:right], (expects.size, expects.size))
    return _square_crop(picture, square_region(box, expects.crop_scale), expects.size)


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


def square_region(box: Box, scale: float) -> Region:
    """Return the square about the box's centre whose side is the longer one times the scale.

    It may reach over the border; left, top, right, bottom as in `box_region`.
    """
    side = max(1, int(max(box[2] - box[0], box[3] - box[1]) * scale))
    left = math.floor((box[0] + box[2] - side) / 2)
    top = math.floor((box[1] + box[3] - side) / 2)
    return left, top, left + side, top + side


def _square_crop(picture: NDArray[np.uint8], region: Region, size: int) -> NDArray[np.uint8]:
    """Mirror the frame where the square reaches over its border, and resize.

    What is in the frame of a large square is reduced before, so that memory does not depend on how
    far it reaches.
    """
    height, width = picture.shape[:2]
    left, top, right, bottom = region
    columns = slice(max(left, 0), min(right, width))
    rows = slice(max(top, 0), min(bottom, height))
    side = min(right - left, _FINER * size)
    ratio = side / (right - left)
    before, shown = [], []
    for part, start, end in ((columns, left, right), (rows, top, bottom)):
        before.append(min(side - 1, round(ratio * (part.start - start))))
        shown.append(max(1, side - before[-1] - round(ratio * (end - part.stop))))
    inside = picture[rows, columns]
    if ratio < 1:
        inside = _resized(inside, (shown[0], shown[1]), cv2.INTER_AREA)
    square = cv2.copyMakeBorder(
        inside,
        before[1],
        side - before[1] - shown[1],
        before[0],
        side - before[0] - shown[0],
        cv2.BORDER_REFLECT_101,
    )
    kind = cv2.INTER_AREA if side > size else cv2.INTER_LANCZOS4
    return _resized(np.asarray(square, dtype=np.uint8), (size, size), kind)


def _resized(
    picture: NDArray[np.uint8], size: tuple[int, int], kind: int = cv2.INTER_LINEAR
) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(picture, size, interpolation=kind), dtype=np.uint8)
