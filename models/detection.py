"""What every face detector does alike: the canvas, and which canvas speaks for which face."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from models.boxes import Face, intersection_over_union, non_maximum_suppression
from models.errors import LowQuality, ModelError
from models.sessions import Session

DEFAULT_SIZE = 640
# A canvas for faces that fill the picture, which the default one makes too large.
NEAR_SIZE = 320
# A canvas that is only asked whether there is such a face.
SCOUT_SIZE = 128
# Longer side, in canvas pixels, of the largest face that the main canvas is trusted with: of 480
# pixels SCRFD finds half and none of 540, and the points of YuNet wander (docs/models.md).
LARGEST_FACE = 480
# Share of the picture's longer side from which on a face on that canvas asks to be confirmed.
LARGE_SHARE = 0.25
# Smaller faces on the near canvas are left to the main one, which shows them twice as large.
SMALLEST_NEAR_FACE = 32
# Two passes found the same face when their boxes overlap by so much.
_SAME_FACE = 0.4
# Added on each side as a share of that side, for crops so tight that the head fills them.
RETRY_BORDER = 0.4
# Side of each of the four small pictures in pixels: a detector confuses up and down least there.
_UPRIGHT_SIDE = 64
# Of the five points of a face, in canvas pixels.
_LEAST_SPREAD = 1.0

Size = tuple[int, int]  # height, width


Candidates = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Boxes (k, 4), scores (k,) and points (k, 5, 2) of one stride, in pixels of the canvas."""


class Detector(ABC):
    """A face detector with five points per face.

    Parameters
    ----------
    session
        A graph with one image input.
    size
        Side of the canvas, a multiple of 32, where the graph does not fix it.

    Attributes
    ----------
    sizes
        The main canvas and, below it, the near one; only the graph's own where it has one.
    """

    kind: str
    score_threshold: float
    recommended_score: float
    """For photos of a person who wants to be seen."""
    clear_score: float
    """What nearly every upright face reaches that nothing covers, and no turned one does."""
    overlap: float
    """Share from which on two boxes are one face."""
    enlarges: bool
    """Whether a picture that is smaller than the canvas is enlarged to fill it."""

    def __init__(self, session: Session, *, size: int = DEFAULT_SIZE) -> None:
        self._session = session
        height, width = session.inputs[0].shape[2:]
        self.is_fixed = height is not None and width is not None
        self.sizes: tuple[Size, ...] = ((size, size),)
        if height is not None and width is not None:
            self.sizes = ((height, width),)
        elif size > NEAR_SIZE:
            self.sizes = ((size, size), (NEAR_SIZE, NEAR_SIZE))

    def canvas(self, image: NDArray[np.uint8], size: Size) -> Size:  # noqa: ARG002 - of some kinds
        """The canvas that a pass of ``size`` really takes for ``image``."""
        return size

    @abstractmethod
    def candidates(self, canvas: NDArray[np.uint8]) -> Iterable[Candidates]:
        """What reaches the threshold of scores on a canvas (h, w, 3), by stride."""

    def detect_once(self, image: NDArray[np.uint8], size: Size) -> list[Face]:
        """Faces found in one pass on a canvas of ``size``, in pixels of ``image``.

        Candidates that are not finite, empty, or whose points coincide are dropped.
        """
        canvas, scale = letterbox(image, self.canvas(image, size), enlarge=self.enlarges)
        strides = zip(*self.candidates(canvas), strict=True)
        boxes, scores, points = (np.concatenate(values) for values in strides)
        # A wild regression must not reach the alignment, which divides by the spread of the points.
        with np.errstate(invalid="ignore", over="ignore"):
            sound = (
                np.isfinite(boxes).all(axis=1)
                & np.isfinite(points).all(axis=(1, 2))
                & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
                & (np.ptp(points, axis=1).max(axis=1) > _LEAST_SPREAD)
            )
        boxes, scores, points = boxes[sound] / scale, scores[sound], points[sound] / scale
        kept = non_maximum_suppression(boxes, scores, threshold=self.overlap)
        return [Face(boxes[i], float(scores[i]), points[i]) for i in kept]

    def run(
        self, blob: NDArray[np.float32], outputs: Sequence[str] | None = None
    ) -> list[NDArray[np.float32]]:
        """Run the graph on one canvas, (1, 3, h, w)."""
        return self._session.run({self._session.inputs[0].name: blob}, outputs)

    def require_fit(self, fits: bool, stride: int) -> None:
        """Refuse outputs that are not those of a canvas."""
        if not fits:
            raise ModelError(
                f"{self._session.name}: the outputs at stride {stride} do not fit the canvas."
            )


def find_faces(detector: Detector, image: NDArray[np.uint8]) -> list[Face]:
    """Detect each face on the canvas that shows it at a size the detector knows.

    Detectors lose sight of a face that fills a canvas of 640, and may then take an ear or somebody
    in the background for the only face. So a quick pass on a small canvas first asks for large
    faces. The main canvas speaks alone where it confirms them all; its points are those that
    InsightFace finds at that size. Otherwise the near canvas adds what the main one missed or was
    not sure of; and where a face is too large for the main canvas, only the smallest faces come
    from there. When nothing is found, the near canvas and then a border around the picture are
    tried.
    """
    main, near = detector.sizes[0], detector.sizes[-1]
    canvas = detector.canvas(image, main)
    if detector.canvas(image, near) == canvas:  # the same pass again would find the same
        return detector.detect_once(image, main) or _inside_border(detector, image, main)
    large = _large_faces(detector, image) if max(canvas) > LARGEST_FACE else []
    longest = max(image.shape[:2])
    sight = LARGEST_FACE / max(canvas) * longest
    blind = any(_longer_side(face) > sight for face in large)
    if blind and longest <= max(near):
        # The near canvas shows all that such a picture has.
        on_main = []
    else:
        on_main = detector.detect_once(image, main)
        certain = [face for face in on_main if face.score >= detector.recommended_score]
        if on_main and not blind and all(_among(face, certain) for face in large):
            return on_main
    on_near = detector.detect_once(image, near)
    if not on_near:
        if blind and not on_main:
            on_main = detector.detect_once(image, main)
        return on_main or _inside_border(detector, image, main)
    limit = SMALLEST_NEAR_FACE / max(near) * longest
    sure = detector.recommended_score
    faces = [
        face for face in on_main if _longer_side(face) < limit or (face.score >= sure and not blind)
    ]
    faces += [face for face in on_near if not _among(face, faces)]
    return sorted(faces, key=lambda face: face.score, reverse=True)


def _large_faces(detector: Detector, image: NDArray[np.uint8]) -> list[Face]:
    """Faces of at least `LARGE_SHARE` of the picture, from a quick pass on a small canvas."""
    small = _shrunk(image, 2 * SCOUT_SIZE)
    shrink = min(1.0, SCOUT_SIZE / max(small.shape[:2]))
    height, width = (max(1, round(side * shrink)) for side in small.shape[:2])
    # The last half by areas: single pixels of a grainy photo are noise.
    small = np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    scale = np.array([width / image.shape[1], height / image.shape[0]], dtype=np.float32)
    return [
        face.moved(np.zeros(2, np.float32), scale)
        for face in detector.detect_once(small, (SCOUT_SIZE, SCOUT_SIZE))
        if _longer_side(face) >= LARGE_SHARE * max(height, width)
    ]


def _among(face: Face, others: Sequence[Face]) -> bool:
    """Whether one of ``others`` is the same face."""
    return any(intersection_over_union(face.box, other.box) > _SAME_FACE for other in others)


def _longer_side(face: Face) -> float:
    return max(face.width, face.height)


def _inside_border(detector: Detector, image: NDArray[np.uint8], main: Size) -> list[Face]:
    """Faces found with a black border around the picture, in pixels of ``image``."""
    height, width = image.shape[:2]
    # Only what the canvas needs is kept, so that the border of a 24 MP photo costs no second one.
    small = _shrunk(image, max(main))
    fy, fx = small.shape[0] / height, small.shape[1] / width
    pad_y = round(round(height * RETRY_BORDER) * fy)
    pad_x = round(round(width * RETRY_BORDER) * fx)
    bordered = cv2.copyMakeBorder(small, pad_y, pad_y, pad_x, pad_x, cv2.BORDER_CONSTANT)
    faces = detector.detect_once(np.asarray(bordered, dtype=np.uint8), main)
    offset, scale = np.array([[pad_x, pad_y], [fx, fy]], dtype=np.float32)
    return [face.moved(offset, scale) for face in faces]


def require_upright(detector: Detector, face: Face, crop: NDArray[np.uint8]) -> None:
    """Refuse a face that is upside down or lies on its side, whatever else is asked of it.

    Where the detector is less than sure of a face, it looks once at four small copies of the
    aligned crop, each turned by another right angle: it is surest of the upright one.
    """
    if face.score >= detector.clear_score:
        return
    small = cv2.resize(crop, (_UPRIGHT_SIDE, _UPRIGHT_SIDE), interpolation=cv2.INTER_AREA)
    turned = [np.rot90(small, quarter) for quarter in range(4)]
    sheet = np.vstack([np.hstack(turned[:2]), np.hstack(turned[2:])])
    size: Size = detector.sizes[0] if detector.is_fixed else (2 * _UPRIGHT_SIDE, 2 * _UPRIGHT_SIDE)
    scores = np.zeros((2, 2))
    for seen in detector.detect_once(np.ascontiguousarray(sheet, dtype=np.uint8), size):
        column, row = (seen.box[:2] + seen.box[2:]) / 2 >= _UPRIGHT_SIDE
        scores[int(row), int(column)] = max(scores[int(row), int(column)], seen.score)
    if turns := int(scores.argmax()):
        raise LowQuality(
            "The photo is upside down: turn it."
            if turns == 2
            else "The photo lies on its side: hold it upright.",
            details={"turned": {"value": 90 * turns, "limit": 0}},
        )


def _shrunk(image: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """The picture with a longer side of at most ``longest`` pixels."""
    height, width = image.shape[:2]
    shrink = min(1.0, longest / max(height, width))
    return resize(image, max(1, round(height * shrink)), max(1, round(width * shrink)))


def resize(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Bilinear resize, as the public detectors were evaluated with."""
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


def letterbox(
    image: NDArray[np.uint8], size: Size, *, enlarge: bool
) -> tuple[NDArray[np.uint8], float]:
    """Resize into the top-left corner of a black canvas, keeping the aspect ratio.

    Also returns the scale, in canvas pixels per image pixel.

    The sides are cut to whole pixels and the scale is that of the cut height, as InsightFace
    does: embedders are trained and evaluated on crops that come from its key points, and half a
    pixel of the canvas is several pixels of a photo that is far from square.
    """
    height, width = image.shape[:2]
    ratio = height / width
    if not enlarge and height <= size[0] and width <= size[1]:
        new_height, new_width = height, width
    elif ratio > size[0] / size[1]:
        new_height, new_width = size[0], int(size[0] / ratio)
    else:
        new_height, new_width = int(size[1] * ratio), size[1]
    # A sliver keeps one row or column of pixels.
    new_height, new_width = max(1, new_height), max(1, new_width)
    canvas = np.zeros((*size, 3), dtype=np.uint8)
    canvas[:new_height, :new_width] = resize(image, new_height, new_width)
    return canvas, new_height / height


def channels_first(
    canvas: NDArray[np.uint8], order: tuple[int, int, int] = (0, 1, 2)
) -> NDArray[np.float32]:
    """The channels of a canvas (h, w, 3) in an order, shape (1, 3, h, w)."""
    # A seventh of the time of a transposed copy, which reads every third byte three times.
    channels = cv2.split(canvas)
    blob = np.empty((1, 3, *canvas.shape[:2]), dtype=np.float32)
    for plane, channel in zip(blob[0], order, strict=True):
        plane[...] = channels[channel]
    return blob


def cell_corners(cells: NDArray[np.intp], columns: int, *, stride: int) -> NDArray[np.float32]:
    """Top-left corners of grid cells in pixels, (k, 2), by their numbers, row by row."""
    y, x = np.divmod(cells, columns)
    return np.stack([x, y], axis=1).astype(np.float32) * np.float32(stride)
