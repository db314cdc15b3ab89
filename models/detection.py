"""What every face detector does alike: the canvas, and looking again when nothing was found."""

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from models.boxes import Face, non_maximum_suppression

DEFAULT_SIZE = 640
RETRY_SIZE = 320
# Added on each side as a share of that side, for crops so tight that the head fills them.
RETRY_BORDER = 0.4
# Of the five points of a face, in canvas pixels.
_LEAST_SPREAD = 1.0

Size = tuple[int, int]  # height, width


class Detector(Protocol):
    """A face detector with five points per face."""

    kind: str
    sizes: tuple[Size, ...]
    score_threshold: float
    recommended_score: float

    def canvas(self, image: NDArray[np.uint8], size: Size) -> Size:
        """The canvas that a pass of ``size`` really takes for ``image``."""
        ...

    def detect_once(self, image: NDArray[np.uint8], size: Size) -> list[Face]:
        """Faces found in one pass on a canvas of ``size``, in pixels of ``image``."""
        ...


def canvas_sizes(size: int, fixed: Size | None) -> tuple[Size, ...]:
    """Canvases to try in order: ``size``, then 320; only the graph's own where it has one."""
    if fixed is not None:
        return (fixed,)
    if size <= RETRY_SIZE:
        return ((size, size),)
    return ((size, size), (RETRY_SIZE, RETRY_SIZE))


def find_faces(detector: Detector, image: NDArray[np.uint8]) -> list[Face]:
    """Detect; when nothing is found, look again on a small canvas, then inside a border.

    A face that fills the picture is larger than what a detector saw in training at 640; the
    smaller canvas and the border both make it relatively smaller.

    Parameters
    ----------
    image
        RGB uint8, shape (h, w, 3).

    Returns
    -------
    list of Face
        In pixels of ``image``, best score first; empty when all passes found nothing.
    """
    tried = set()
    for size in detector.sizes:
        canvas = detector.canvas(image, size)
        if canvas in tried:  # the same pass again would find the same
            continue
        tried.add(canvas)
        faces = detector.detect_once(image, size)
        if faces:
            return faces
    height, width = image.shape[:2]
    top, left = round(height * RETRY_BORDER), round(width * RETRY_BORDER)
    # Only what the canvas needs is kept, so that the border of a 24 MP photo costs no second one.
    shrink = min(1.0, max(detector.sizes[0]) / max(height, width))
    small = resize(image, max(1, round(height * shrink)), max(1, round(width * shrink)))
    fy, fx = small.shape[0] / height, small.shape[1] / width
    pad_y, pad_x = round(top * fy), round(left * fx)
    bordered = cv2.copyMakeBorder(small, pad_y, pad_y, pad_x, pad_x, cv2.BORDER_CONSTANT)
    faces = detector.detect_once(np.asarray(bordered, dtype=np.uint8), detector.sizes[0])
    scale = np.array([fx, fy], dtype=np.float32)
    offset = np.array([pad_x, pad_y], dtype=np.float32)
    return [
        Face(
            box=((face.box.reshape(2, 2) - offset) / scale).reshape(4),
            score=face.score,
            keypoints=(face.keypoints - offset) / scale,
        )
        for face in faces
    ]


def resize(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Bilinear resize, as the public detectors were evaluated with."""
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


def letterbox(
    image: NDArray[np.uint8], size: Size, *, enlarge: bool
) -> tuple[NDArray[np.uint8], float]:
    """Resize into the top-left corner of a black canvas, keeping the aspect ratio.

    Parameters
    ----------
    size
        Height and width of the canvas.
    enlarge
        Whether a picture smaller than the canvas is enlarged to fill it.

    Returns
    -------
    canvas : ndarray of uint8, shape (height, width, 3)
    scale : float
        Canvas pixels per image pixel.
    """
    height, width = image.shape[:2]
    scale = min(size[0] / height, size[1] / width)
    if not enlarge:
        scale = min(scale, 1.0)
    new_height = min(size[0], max(1, round(height * scale)))
    new_width = min(size[1], max(1, round(width * scale)))
    canvas = np.zeros((*size, 3), dtype=np.uint8)
    canvas[:new_height, :new_width] = resize(image, new_height, new_width)
    return canvas, scale


def cell_centres(rows: int, columns: int, *, stride: int, per_cell: int) -> NDArray[np.float32]:
    """Top-left corner of each grid cell in pixels, row by row, shape (rows*columns*per_cell, 2)."""
    y, x = np.mgrid[:rows, :columns]
    grid = np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32) * stride
    return np.repeat(grid, per_cell, axis=0)


def faces_from_candidates(
    boxes: Sequence[NDArray[np.float32]],
    scores: Sequence[NDArray[np.float32]],
    keypoints: Sequence[NDArray[np.float32]],
    *,
    overlap: float,
    scale: float,
) -> list[Face]:
    """Join the candidates of all strides, suppress duplicates, return to image pixels.

    Candidates that are not finite, empty, or whose points coincide are dropped.
    """
    all_boxes, all_scores = np.concatenate(boxes), np.concatenate(scores)
    all_points = np.concatenate(keypoints)
    # A wild regression must not reach the alignment, which divides by the spread of the points.
    with np.errstate(invalid="ignore", over="ignore"):
        sound = (
            np.isfinite(all_boxes).all(axis=1)
            & np.isfinite(all_points).all(axis=(1, 2))
            & (all_boxes[:, 2:] > all_boxes[:, :2]).all(axis=1)
            & (np.ptp(all_points, axis=1).max(axis=1) > _LEAST_SPREAD)
        )
    all_boxes, all_scores, all_points = all_boxes[sound], all_scores[sound], all_points[sound]
    kept = non_maximum_suppression(all_boxes, all_scores, threshold=overlap)
    return [
        Face(
            box=np.asarray(all_boxes[i] / scale, dtype=np.float32),
            score=float(all_scores[i]),
            keypoints=np.asarray(all_points[i] / scale, dtype=np.float32),
        )
        for i in kept
    ]
