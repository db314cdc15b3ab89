"""YuNet, the detector of the OpenCV Zoo (W. Wu, H. Peng, S. Yu, 2023)."""

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

STRIDES = (8, 16, 32)
OVERLAP = 0.3
OUTPUTS = tuple(f"{role}_{stride}" for role in ("cls", "obj", "bbox", "kps") for stride in STRIDES)
# exp of a wild regression must not overflow; 2**10 strides exceed any canvas.
_MAX_LOG_SIDE = 7.0


class YuNet(Detector):
    """YuNet with five points; the graph has the outputs ``cls_8`` ... ``kps_32``."""

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
        named = dict(
            zip(OUTPUTS, self._session.run({self._input_name: blob}, OUTPUTS), strict=True)
        )
        boxes, scores, keypoints = [], [], []
        for stride in STRIDES:
            rows, columns = size[0] // stride, size[1] // stride
            cls = named[f"cls_{stride}"].reshape(-1)
            if len(cls) != rows * columns:
                raise self._misfit(stride, size)
            obj = named[f"obj_{stride}"].reshape(-1)
            score = np.sqrt(np.clip(cls, 0, 1) * np.clip(obj, 0, 1))
            cells = np.flatnonzero(score >= self.score_threshold)
            corner = cell_corners(cells, columns, stride=stride)
            box = named[f"bbox_{stride}"].reshape(-1, 4)[cells]
            centre = corner + box[:, :2] * stride
            half = np.exp(np.minimum(box[:, 2:], _MAX_LOG_SIDE)) * (stride / 2)
            boxes.append(np.concatenate([centre - half, centre + half], axis=1))
            scores.append(score[cells])
            points = named[f"kps_{stride}"].reshape(-1, 5, 2)[cells]
            keypoints.append(corner[:, None, :] + points * stride)
        return faces_from_candidates(boxes, scores, keypoints, overlap=OVERLAP, scale=scale)


def _trimmed(image: NDArray[np.uint8], size: Size) -> Size:
    """Smallest canvas of whole 32-pixel blocks that holds the picture, at most ``size``."""
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1], 1.0)
    return (
        min(size[0], max(32, -(-round(image.shape[0] * scale) // 32) * 32)),
        min(size[1], max(32, -(-round(image.shape[1] * scale) // 32) * 32)),
    )
