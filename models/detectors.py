"""SCRFD, the detector of the InsightFace packs, and YuNet, that of the OpenCV Zoo."""

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
YUNET_OUTPUTS = tuple(
    f"{role}_{stride}" for role in ("cls", "obj", "bbox", "kps") for stride in STRIDES
)
_SCRFD_OVERLAP = 0.4
_YUNET_OVERLAP = 0.3
# exp of a wild regression must not overflow; 2**10 strides exceed any canvas.
_MAX_LOG_SIDE = 7.0


class Scrfd(Detector):
    """SCRFD with keypoints: pictures are enlarged to fill the canvas, so each size is another one.

    The graph has nine outputs: scores, boxes and points at strides 8, 16 and 32, boxes and points
    as distances from the cell in units of the stride.

    References
    ----------
    J. Guo et al., Sample and computation redistribution for efficient face detection, ICLR 2022.
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
        return faces_from_candidates(boxes, scores, keypoints, overlap=_SCRFD_OVERLAP, scale=scale)


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


class YuNet(Detector):
    """YuNet with five points; the graph has the outputs ``cls_8`` ... ``kps_32``.

    References
    ----------
    W. Wu, H. Peng, S. Yu, YuNet: a tiny millisecond-level face detector, 2023.
    """

    kind = "yunet"
    score_threshold = 0.6
    recommended_score = 0.7
    clear_score = 0.92

    def canvas(self, image: NDArray[np.uint8], size: Size) -> Size:
        """Canvas of a pass: no larger than the picture needs, unless the graph fixes it."""
        return size if self.is_fixed else _trimmed(image, size)

    def detect_once(self, image: NDArray[np.uint8], size: Size) -> list[Face]:
        """Faces found in one pass on a canvas of ``size``, in pixels of ``image``."""
        size = self.canvas(image, size)
        canvas, scale = letterbox(image, size, enlarge=False)
        blob = channels_first(canvas, (2, 1, 0))
        answers = self._session.run({self._input_name: blob}, YUNET_OUTPUTS)
        outputs = dict(zip(YUNET_OUTPUTS, answers, strict=True))
        boxes, scores, keypoints = [], [], []
        for stride in STRIDES:
            rows, columns = size[0] // stride, size[1] // stride
            cls = outputs[f"cls_{stride}"].reshape(-1)
            if len(cls) != rows * columns:
                raise self._misfit(stride, size)
            obj = outputs[f"obj_{stride}"].reshape(-1)
            score = np.sqrt(np.clip(cls, 0, 1) * np.clip(obj, 0, 1))
            cells = np.flatnonzero(score >= self.score_threshold)
            corner = cell_corners(cells, columns, stride=stride)
            box = outputs[f"bbox_{stride}"].reshape(-1, 4)[cells]
            centre = corner + box[:, :2] * stride
            half = np.exp(np.minimum(box[:, 2:], _MAX_LOG_SIDE)) * (stride / 2)
            boxes.append(np.concatenate([centre - half, centre + half], axis=1))
            scores.append(score[cells])
            points = outputs[f"kps_{stride}"].reshape(-1, 5, 2)[cells]
            keypoints.append(corner[:, None, :] + points * stride)
        return faces_from_candidates(boxes, scores, keypoints, overlap=_YUNET_OVERLAP, scale=scale)


def _trimmed(image: NDArray[np.uint8], size: Size) -> Size:
    """Smallest canvas of whole 32-pixel blocks that holds the picture, at most ``size``."""
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1], 1.0)
    return (
        min(size[0], max(32, -(-round(image.shape[0] * scale) // 32) * 32)),
        min(size[1], max(32, -(-round(image.shape[1] * scale) // 32) * 32)),
    )
