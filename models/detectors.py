"""SCRFD, the detector of the InsightFace packs, and YuNet, that of the OpenCV Zoo."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from models.detection import Candidates, Detector, Size, cell_corners, channels_first
from models.errors import ModelError

STRIDES = (8, 16, 32)
YUNET_OUTPUTS = tuple(
    f"{role}_{stride}" for role in ("cls", "obj", "bbox", "kps") for stride in STRIDES
)
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
    overlap = 0.4
    enlarges = True

    def candidates(self, canvas: NDArray[np.uint8]) -> Iterator[Candidates]:
        """What reaches the threshold of scores on a canvas (h, w, 3), by stride."""
        blob = channels_first(canvas)
        blob -= np.float32(127.5)
        blob *= np.float32(1 / 128)
        by_stride = _by_stride(self.run(blob))
        for stride, (score, distance, point) in zip(STRIDES, by_stride, strict=True):
            rows, columns = canvas.shape[0] // stride, canvas.shape[1] // stride
            per_cell, rest = divmod(len(score), rows * columns)
            self.require_fit(
                per_cell > 0 and not rest and len(score) == len(distance) == len(point), stride
            )
            cells = np.flatnonzero(score >= self.score_threshold)
            centres = cell_corners(cells // per_cell, columns, stride=stride)
            reach = distance[cells] * stride
            boxes = np.concatenate([centres - reach[:, :2], centres + reach[:, 2:]], axis=1)
            points = centres[:, None, :] + point[cells].reshape(-1, 5, 2) * stride
            yield boxes, score[cells], points


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
    overlap = 0.3
    enlarges = False

    def canvas(self, image: NDArray[np.uint8], size: Size) -> Size:
        """Smallest canvas of whole 32-pixel blocks that holds the picture, at most ``size``."""
        if self.is_fixed:
            return size
        height, width = image.shape[:2]
        scale = min(size[0] / height, size[1] / width, 1.0)
        rows, columns = (-(-round(side * scale) // 32) * 32 for side in (height, width))
        return min(size[0], max(32, rows)), min(size[1], max(32, columns))

    def candidates(self, canvas: NDArray[np.uint8]) -> Iterator[Candidates]:
        """What reaches the threshold of scores on a canvas (h, w, 3), by stride."""
        answers = self.run(channels_first(canvas, (2, 1, 0)), YUNET_OUTPUTS)
        outputs = dict(zip(YUNET_OUTPUTS, answers, strict=True))
        for stride in STRIDES:
            rows, columns = canvas.shape[0] // stride, canvas.shape[1] // stride
            cls, obj = (outputs[f"{role}_{stride}"].reshape(-1) for role in ("cls", "obj"))
            self.require_fit(len(cls) == rows * columns, stride)
            score = np.sqrt(np.clip(cls, 0, 1) * np.clip(obj, 0, 1))
            cells = np.flatnonzero(score >= self.score_threshold)
            corner = cell_corners(cells, columns, stride=stride)
            box = outputs[f"bbox_{stride}"].reshape(-1, 4)[cells]
            centre = corner + box[:, :2] * stride
            half = np.exp(np.minimum(box[:, 2:], _MAX_LOG_SIDE)) * (stride / 2)
            points = outputs[f"kps_{stride}"].reshape(-1, 5, 2)[cells]
            boxes = np.concatenate([centre - half, centre + half], axis=1)
            yield boxes, score[cells], corner[:, None, :] + points * stride
