"""Where a head points and how near it is, from five points: what a flat picture cannot fake.

Eyes and mouth lie near one plane, and the nose stands out of it. Any picture of any plane, however
it is held and however near the camera is, shows eyes and mouth moved by a homography, and takes the
nose along. So the homography that puts eyes and mouth back on the template puts the nose of a
photo in the same place in every frame, and moves that of a turning head.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.alignment import TEMPLATE_112
from models.errors import LowQuality
from models.quality import measure_pose

_NOSE = 2
_OUTLINE = [0, 1, 3, 4]
# Half the distance of the eyes, and from eyes to mouth, on the template.
_HALF_EYES = float(np.hypot(*(TEMPLATE_112[1] - TEMPLATE_112[0]))) / 2
_HEIGHT = float(np.hypot(*(TEMPLATE_112[3] + TEMPLATE_112[4] - TEMPLATE_112[:2].sum(axis=0)))) / 2


@dataclass(frozen=True)
class HeadPose:
    """Pose of one head in one picture."""

    yaw: float  # degrees; positive when the nose points to the right of the picture
    pitch: float  # degrees; positive when the face looks down
    roll: float  # degrees; positive when the head is turned clockwise in the picture
    scale: float  # of the head over that of the 112-pixel template; turning does not change it
    centre: tuple[float, float]  # x and y of the middle of the five points, in pixels


def head_pose(keypoints: NDArray[np.floating]) -> HeadPose:
    """Measure the pose of a head by its five points.

    Notes
    -----
    Yaw and pitch are those of :func:`models.quality.measure_pose` once eyes and mouth lie on the
    template. For one person their changes count; where they are 0 differs by about 10 degrees
    between people. Of a plane that is turned by an angle, the axis of the turn keeps its length,
    so the larger of the two singular values is the scale.
    """
    points = np.asarray(keypoints, dtype=np.float64)
    flattened = TEMPLATE_112.copy()
    flattened[_NOSE] = _on_template(points)
    yaw, pitch, _ = measure_pose(flattened)
    left, right, _, mouth_left, mouth_right = points
    frame = np.stack(
        [
            (right - left) / 2 / _HALF_EYES,
            (mouth_left + mouth_right - left - right) / 2 / _HEIGHT,
        ]
    )
    x, y = points.mean(axis=0)
    return HeadPose(
        yaw=yaw,
        pitch=pitch,
        roll=measure_pose(points)[2],
        scale=float(np.linalg.norm(frame, 2)),
        centre=(float(x), float(y)),
    )


def _on_template(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the nose comes to lie when eyes and mouth are put on the template, (2,)."""
    rows, targets = [], []
    for (x, y), (u, v) in zip(points[_OUTLINE], TEMPLATE_112[_OUTLINE], strict=True):
        rows += [[x, y, 1, 0, 0, 0, -x * u, -y * u], [0, 0, 0, x, y, 1, -x * v, -y * v]]
        targets += [u, v]
    try:
        homography = np.append(np.linalg.solve(np.array(rows), np.array(targets)), 1.0)
    except np.linalg.LinAlgError:
        homography = np.zeros(9)
    u, v, w = homography.reshape(3, 3) @ np.append(points[_NOSE], 1.0)
    if not (np.isfinite([u, v, w]).all() and abs(w) > 1e-9):
        raise LowQuality(
            "The eyes and the mouth are not where those of a face are. Show the whole face.",
            details={"pose": {}},
        )
    return np.array([u / w, v / w])
