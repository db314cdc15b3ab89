"""Which way up a photo is: detectors put the points of an upright face on one that is not."""

import cv2
import numpy as np
from numpy.typing import NDArray

from models.boxes import Face
from models.detection import Detector, Size
from models.errors import LowQuality

# Side of each of the four small pictures in pixels: a detector confuses up and down least there.
_SIDE = 64


def quarter_turns(detector: Detector, crop: NDArray[np.uint8]) -> int:
    """Quarter turns to the left that put a face upright; 0 where it is.

    The detector looks once at four small copies of the aligned crop, each turned by another right
    angle: it is surest of the upright one.

    Parameters
    ----------
    crop
        RGB uint8, shape (s, s, 3), aligned by the points that the detector found.
    """
    small = cv2.resize(crop, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    turned = [np.rot90(small, quarter) for quarter in range(4)]
    sheet = np.vstack([np.hstack(turned[:2]), np.hstack(turned[2:])])
    size: Size = detector.sizes[0] if detector.is_fixed else (2 * _SIDE, 2 * _SIDE)
    scores = np.zeros((2, 2))
    for face in detector.detect_once(np.ascontiguousarray(sheet, dtype=np.uint8), size):
        column, row = (face.box[:2] + face.box[2:]) / 2 >= _SIDE
        scores[int(row), int(column)] = max(scores[int(row), int(column)], face.score)
    return int(scores.argmax())


def require_upright(detector: Detector, face: Face, crop: NDArray[np.uint8]) -> None:
    """Refuse a face that is upside down or lies on its side, whatever else is asked of it.

    A second look is taken only of a face that the detector is less than sure of.

    Raises
    ------
    LowQuality
        With ``turned`` in its details.
    """
    if face.score >= detector.clear_score:
        return
    if turns := quarter_turns(detector, crop):
        raise LowQuality(
            "The photo is upside down: turn it."
            if turns == 2
            else "The photo lies on its side: hold it upright.",
            details={"turned": {"value": 90 * turns, "limit": 0}},
        )
