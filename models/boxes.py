"""Faces as boxes with five points: the value, its rank, and non-maximum suppression."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# A detector has up to 16,800 cells at 640 x 640. Greedy suppression is quadratic in what is kept,
# and no photo of a face needs more candidates than this.
MAX_CANDIDATES = 1000


@dataclass(frozen=True, eq=False, repr=False)
class Face:
    """One detected face, in pixels of the upright image.

    The points are left eye, right eye, nose, left and right mouth corner as the viewer sees them.
    """

    box: NDArray[np.float32]  # (4,): x1, y1, x2, y2; it may reach over the image's border
    score: float  # confidence, 0...1; detectors differ in what a value means
    keypoints: NDArray[np.float32]  # (5, 2)

    def moved(self, offset: NDArray[np.float32], scale: NDArray[np.float32]) -> "Face":
        """The same face in a crop from ``offset`` on, whose pixels are ``scale`` times as large."""
        corners = (self.box.reshape(2, 2) - offset) / scale
        return Face(corners.reshape(4), self.score, (self.keypoints - offset) / scale)

    @property
    def width(self) -> float:
        """Width of the box in pixels."""
        return float(self.box[2] - self.box[0])

    @property
    def height(self) -> float:
        """Height of the box in pixels."""
        return float(self.box[3] - self.box[1])

    @property
    def area(self) -> float:
        """Area of the box in pixels."""
        return max(self.width, 0.0) * max(self.height, 0.0)


def ranked(faces: Sequence[Face], image_shape: tuple[int, ...]) -> list[Face]:
    """Faces, the one that is most likely meant first.

    The rank is InsightFace's, ``area - 2 * ‖box centre - image centre‖²``.
    """
    middle = np.array([image_shape[1], image_shape[0]]) / 2

    def rank(face: Face) -> float:
        distance = (face.box[:2] + face.box[2:]) / 2 - middle
        return face.area - 2 * float(distance @ distance)

    return sorted(faces, key=rank, reverse=True)


def intersection_over_union(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Shared area of two boxes (x1, y1, x2, y2) over the area they cover together, 0...1."""
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    shared = max(float(width), 0.0) * max(float(height), 0.0)
    areas = sum(float((box[2] - box[0]) * (box[3] - box[1])) for box in (first, second))
    return shared / (areas - shared)


def non_maximum_suppression(
    boxes: NDArray[np.float32], scores: NDArray[np.float32], *, threshold: float
) -> NDArray[np.intp]:
    """Greedy suppression of boxes that overlap a better one."""
    if not len(boxes):
        return np.empty(0, dtype=np.intp)
    corners = boxes.astype(np.float64)
    with_sides = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)
    kept = cv2.dnn.NMSBoxes(
        with_sides.tolist(), scores.tolist(), 0.0, threshold, top_k=MAX_CANDIDATES
    )
    return np.asarray(kept, dtype=np.intp)
