"""SCRFD, the detector of the InsightFace packs (J. Guo et al., ICLR 2022)."""

import numpy as np
from numpy.typing import NDArray

from models.boxes import Face
from models.detection import (
    Detector,
    Size,
    cell_corners,
    channels_first,
    faces_from_candidates,
    letterbox,
)
from models.errors import ModelError

STRIDES = (8, 16, 32)
OVERLAP = 0.4


class Scrfd(Detector):
    """SCRFD with keypoints: pictures are enlarged to fill the canvas, so each size is another one.

    The graph has nine outputs: scores, boxes and points at strides 8, 16 and 32, boxes and points
    as distances from the cell in units of the stride.
    """

    kind = "scrfd"
    score_threshold = 0.5
    recommended_score = 0.6
    clear_score = 0.75

    def detect_once(self, image: NDArray[np.uint8], size: Size) -> list[Face]:
        """Faces found in one pass on a canvas of ``size``, in pixels of ``image``."""
        canvas, scale = letterbox(image, size, enlarge=True)
        blob = channels_first(canvas)
        blob -= np.float32(127.5)
        blob *= np.float32(1 / 128)
        outputs = self._session.run({self._input_name: blob})
        boxes, scores, keypoints = [], [], []
        for stride, (score, distance, point) in zip(STRIDES, _by_stride(outputs), strict=True):
            rows, columns = size[0] // stride, size[1] // stride
            per_cell, rest = divmod(len(score), rows * columns)
            if rest or per_cell == 0 or len(distance) != len(score) or len(point) != len(score):
                raise self._misfit(stride, size)
            cells = np.flatnonzero(score >= self.score_threshold)
            centres = cell_corners(cells, columns, stride=stride, per_cell=per_cell)
            reach = distance[cells] * stride
            boxes.append(np.concatenate([centres - reach[:, :2], centres + reach[:, 2:]], axis=1))
            scores.append(score[cells])
            keypoints.append(centres[:, None, :] + point[cells].reshape(-1, 5, 2) * stride)
        return faces_from_candidates(boxes, scores, keypoints, overlap=OVERLAP, scale=scale)


def _by_stride(
    outputs: list[NDArray[np.float32]],
) -> list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]]:
    """Scores (k,), distances (k, 4) and points (k, 10) per stride, the finest first.

    Exports differ in the order of the outputs and in a leading batch axis, so the role is told by
    the last axis and the stride by the length.
    """
    groups: dict[int, list[NDArray[np.float32]]] = {1: [], 4: [], 10: []}
    for output in outputs:
        width = output.shape[-1]
        if width not in groups:
            raise ModelError(f"A detector output has {width} values per cell, not 1, 4 or 10.")
        groups[width].append(output.reshape(-1, width))
    for group in groups.values():
        group.sort(key=len, reverse=True)
    return [
        (score[:, 0], distance, point)
        for score, distance, point in zip(groups[1], groups[4], groups[10], strict=True)
    ]
