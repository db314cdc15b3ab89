"""Is this face good enough to enroll or to verify? Measures, limits, and named refusals."""

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from models.alignment import similarity_transform, template
from models.boxes import Face
from models.errors import FaceTooSmall, LowQuality

# All measures are taken on a 112 x 112 crop without its margin, so that limits hold for every
# embedder and hair and background do not vote.
_SIDE = 112
_MARGIN = 20
# Detail finer than this is noise of the sensor and of JPEG, which blur does not remove.
_SMOOTHING = 1.5
# Exposure is read from about so many pixels in each direction.
_EXPOSURE_SIDE = 256
# Geometry of the mean face on the template: half the distance of the eyes over how far the nose
# stands out of the plane of eyes and mouth; the same for the distance from eyes to mouth; and
# where the nose lies between eyes (0) and mouth (1) when the face looks straight ahead (mean of
# both public detectors on LFW).
_EYES_PER_NOSE = 1.41
_HEIGHT_PER_NOSE = 3.26
_NEUTRAL_NOSE = 0.545


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What was measured on one face; None where it came aligned, and nothing was detected."""

    score: float | None = None  # confidence of the detector, 0...1
    face_size: float | None = None  # shorter side of the box in pixels
    sharpness: float  # `measure_sharpness`: about 3 for a sharp photo, below 0.5 useless
    brightness: float  # mean luma of the centre of the aligned crop, 0...255
    exposure: float  # luma that a twentieth of the whole picture exceeds: it knows no skin
    yaw: float | None = None  # degrees, see `measure_pose`
    pitch: float | None = None
    roll: float | None = None
    # Least distance of the five points from the border of the picture, as a share of the crop's
    # side; negative where a point lies outside.
    border: float | None = None
    aspect: float | None = None  # height of the box over its width


@dataclass(frozen=True, kw_only=True)
class QualityLimits:
    """What a face must reach. How the defaults were measured: docs/results/photos.md."""

    min_score: float | None = None  # the detector's recommendation: detectors differ
    min_face_size: float = 24.0  # a smaller face does not count as a further one either
    min_sharpness: float = 0.5
    # In an underexposed picture strangers look alike; a face that is dark in a bright one is
    # recognised down to a far lower luma.
    min_brightness: float = 6.0
    max_brightness: float = 235.0
    min_exposure: float = 40.0
    max_yaw: float = 70.0  # absolute degrees, as the next two
    max_pitch: float = 55.0
    max_roll: float = 45.0
    min_border: float = 0.08
    max_aspect: float = 1.7


DEFAULT_QUALITY = QualityLimits()


def measure(crop: NDArray[np.uint8], face: Face | None, image: NDArray[np.uint8]) -> Quality:
    """Measure one face by its crop, its detection (None where it came aligned) and the picture."""
    grey = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)
    if grey.shape != (_SIDE, _SIDE):
        grey = cv2.resize(grey, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    quality = Quality(
        sharpness=measure_sharpness(np.asarray(grey, dtype=np.uint8)),
        brightness=float(grey[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN].mean()),
        exposure=_exposure(image),
    )
    if face is None:
        return quality
    yaw, pitch, roll = measure_pose(face.keypoints)
    return replace(
        quality,
        score=face.score,
        face_size=min(face.width, face.height),
        yaw=yaw,
        pitch=pitch,
        roll=roll,
        border=_border(face.keypoints, image.shape),
        aspect=face.height / face.width,
    )


def _exposure(image: NDArray[np.uint8]) -> float:
    step = max(1, max(image.shape[:2]) // _EXPOSURE_SIDE)
    grey = cv2.cvtColor(np.ascontiguousarray(image[::step, ::step]), cv2.COLOR_RGB2GRAY)
    return float(np.percentile(grey, 95, method="lower"))


def _border(keypoints: NDArray[np.floating], image_shape: tuple[int, ...]) -> float:
    height, width = image_shape[:2]
    far_corner = np.array([width - 1, height - 1]) - keypoints
    matrix = similarity_transform(keypoints, template(_SIDE))
    scale = float(np.hypot(matrix[0, 0], matrix[1, 0]))
    return min(float(keypoints.min()), float(far_corner.min())) * scale / _SIDE


def measure_sharpness(grey: NDArray[np.uint8]) -> float:
    """Fine detail in the direction that has least of it.

    Second differences of the smoothed picture along the rows, the columns and both diagonals; the
    least mean square of the four, over the variance of the picture, times 1000. A shaken camera
    blurs one direction only, which the usual variance of the Laplacian misses. Dividing by the
    variance makes it independent of exposure and contrast, so that dark skin or soft light is not
    taken for blur.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float64), (0, 0), _SMOOTHING)

    def window(down: int, right: int) -> NDArray[np.float64]:
        """Return the centre of the picture, moved."""
        rows = slice(_MARGIN + down, _SIDE - _MARGIN + down)
        columns = slice(_MARGIN + right, _SIDE - _MARGIN + right)
        return np.asarray(smooth[rows, columns])

    centre = window(0, 0)
    variance = float(centre.var())
    if variance < 1e-6:
        return 0.0
    # Diagonal neighbours are sqrt(2) apart, which doubles a second difference.
    directions = (((0, 1), 1.0), ((1, 0), 1.0), ((1, 1), 0.5), ((1, -1), 0.5))
    energies = []
    for (down, right), weight in directions:
        second = (window(-down, -right) - 2 * centre + window(down, right)) * weight
        energies.append(float((second * second).mean()))
    return 1000 * min(energies) / variance


def measure_pose(keypoints: NDArray[np.floating]) -> tuple[float, float, float]:
    """Yaw, pitch and roll of a face from its five points, in degrees.

    The nose stands out of the plane of eyes and mouth, so turning the head moves it sideways
    between the eyes, and nodding moves it between eyes and mouth. Under weak perspective its
    shift over its height is the tangent of the angle. The order of faces by angle is sound; single
    values are good to about 10 degrees, and an open mouth or a smile reads as a nod.

    Parameters
    ----------
    keypoints
        Shape (5, 2), pixels.

    Returns
    -------
    yaw : float
        Positive when the nose points to the right of the picture.
    pitch : float
        Positive when the face looks down.
    roll : float
        Positive when the head is turned clockwise in the picture.
    """
    matrix = similarity_transform(keypoints, template(_SIDE))
    points = np.asarray(keypoints, dtype=np.float64) @ matrix[:, :2].T + matrix[:, 2]
    left, right, nose, mouth_left, mouth_right = points
    eyes, mouth = (left + right) / 2, (mouth_left + mouth_right) / 2
    axis = mouth - eyes
    height = float(np.hypot(*axis)) or 1e-9
    along = float((nose - eyes) @ axis) / height**2
    across = float(axis[1] * (nose - eyes)[0] - axis[0] * (nose - eyes)[1]) / height
    half_eyes = float(np.hypot(*(right - left))) / 2 or 1e-9
    yaw = np.degrees(np.arctan(_EYES_PER_NOSE * across / half_eyes))
    pitch = np.degrees(np.arctan(_HEIGHT_PER_NOSE * (along - _NEUTRAL_NOSE)))
    roll = np.degrees(np.arctan2(-matrix[1, 0], matrix[0, 0]))
    return float(yaw), float(pitch), float(roll)


def check(
    quality: Quality, limits: QualityLimits = DEFAULT_QUALITY, *, recommended_score: float = 0.0
) -> None:
    """Refuse a face that fails a limit.

    The details map each measure that failed to its value and limit; ``pose`` and ``hidden`` to one
    such pair for each of their parts that failed.
    """
    if quality.face_size is not None and quality.face_size < limits.min_face_size:
        raise FaceTooSmall(
            f"The face is {quality.face_size:.0f} pixels wide; at least"
            f" {limits.min_face_size:.0f} are needed. Come closer or send a larger photo.",
            details={"size": {"value": round(quality.face_size, 3), "limit": limits.min_face_size}},
        )
    failed: dict[str, Any] = {}
    for name, part, value, least, most in _limited(quality, limits, recommended_score):
        if value is None or least <= value <= most:
            continue
        limit = abs(least if value < least else most)
        measured = {"value": round(value, 3), "limit": limit}
        if part is None:
            failed.setdefault(name, measured)
        else:
            failed.setdefault(name, {})[part] = measured
    if failed:
        remedies = " ".join(_REMEDIES[name] for name in failed)
        raise LowQuality(
            f"The photo is not good enough ({', '.join(failed)}). {remedies}", details=failed
        )


def _limited(
    quality: Quality, limits: QualityLimits, recommended_score: float
) -> list[tuple[str, str | None, float | None, float, float]]:
    """List the measures: failure that each belongs to, part of it, value, least and most.

    A detector puts five points on what it sees of a face, as if all of it were there. Where part of
    the face is covered, or lies outside the picture, they reach the border of the picture, and the
    box, which goes round what is seen, is too narrow for its height. A picture that was squeezed
    has such a box too. What covers a face from above or from below leaves the box wide enough.
    """
    min_score = recommended_score if limits.min_score is None else limits.min_score
    return [
        ("score", None, quality.score, min_score, math.inf),
        ("blur", None, quality.sharpness, limits.min_sharpness, math.inf),
        ("darkness", None, quality.exposure, limits.min_exposure, math.inf),
        ("darkness", None, quality.brightness, limits.min_brightness, math.inf),
        ("brightness", None, quality.brightness, -math.inf, limits.max_brightness),
        ("turned", None, quality.roll, -limits.max_roll, limits.max_roll),
        ("pose", "yaw", quality.yaw, -limits.max_yaw, limits.max_yaw),
        ("pose", "pitch", quality.pitch, -limits.max_pitch, limits.max_pitch),
        ("hidden", "border", quality.border, limits.min_border, math.inf),
        ("hidden", "aspect", quality.aspect, -math.inf, limits.max_aspect),
    ]


_REMEDIES = {
    "score": "Show the face unobstructed.",
    "blur": "Hold the camera still and focus on the face.",
    "darkness": "Put more light on the face.",
    "brightness": "Put less light on the face.",
    "turned": "Hold the photo upright.",
    "pose": "Look into the camera.",
    "hidden": "Show the whole face, with nothing before it and some room around it.",
}
