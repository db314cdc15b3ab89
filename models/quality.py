"""Is this face good enough to enroll or to verify? Measures, limits, and named refusals."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from models.boxes import Face
from models.errors import FaceTooSmall, LowQuality, MultipleFaces, NoFace

# Rec. 601 luma, what cv2 uses for RGB to grey.
_CENTRAL = 0.2  # share cut off each side of the crop: hair and background do not vote


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What was measured on one face.

    Attributes
    ----------
    score
        Confidence of the detector, 0...1; ``None`` for crops that came aligned.
    face_size
        Shorter side of the detected box in pixels; ``None`` for crops that came aligned.
    sharpness
        Noise-free detail of the aligned crop, see `measure_sharpness`; no unit.
    brightness
        Mean luma of the centre of the aligned crop, 0...255.
    yaw, pitch, roll
        Degrees, estimated from the five points, see `measure_pose`; ``None`` for crops that came
        aligned.
    """

    score: float | None
    face_size: float | None
    sharpness: float
    brightness: float
    yaw: float | None
    pitch: float | None
    roll: float | None

    def as_dict(self) -> dict[str, float | None]:
        """JSON-able form."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class QualityLimits:
    """What a face must reach. Defaults: docs/models.md, chosen on real photos.

    Attributes
    ----------
    min_score
        Detector confidence.
    min_face_size
        Shorter side of the box in pixels.
    min_sharpness, min_brightness, max_brightness
        As in `Quality`.
    max_yaw, max_pitch, max_roll
        Absolute degrees.
    second_face_share
        A second face counts when its area is at least this share of the main face's.
    """

    min_score: float = 0.5
    min_face_size: float = 32.0
    min_sharpness: float = 0.0
    min_brightness: float = 25.0
    max_brightness: float = 235.0
    max_yaw: float = 60.0
    max_pitch: float = 50.0
    max_roll: float = 60.0
    second_face_share: float = 0.25


DEFAULT_QUALITY = QualityLimits()


def measure(
    crop: NDArray[np.uint8], face: Face | None, *, keypoints: NDArray[np.floating] | None = None
) -> Quality:
    """Measure one face.

    Parameters
    ----------
    crop
        The aligned crop, RGB uint8, shape (s, s, 3).
    face
        The detection it came from; ``None`` for crops that came aligned.
    """
    centre = _centre(crop)
    yaw = pitch = roll = None
    if face is not None:
        yaw, pitch, roll = measure_pose(face.keypoints)
    return Quality(
        score=None if face is None else face.score,
        face_size=None if face is None else min(face.width, face.height),
        sharpness=measure_sharpness(centre),
        brightness=float(centre.mean()),
        yaw=yaw,
        pitch=pitch,
        roll=roll,
    )


def _centre(crop: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey centre of a crop, always 112-scale, so that limits hold for every embedder size."""
    grey = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)
    if grey.shape[0] != 112:
        grey = cv2.resize(grey, (112, 112), interpolation=cv2.INTER_AREA)
    cut = round(112 * _CENTRAL)
    return np.asarray(grey[cut:-cut, cut:-cut], dtype=np.uint8)


def measure_sharpness(grey: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of the picture.

    The quotient does not depend on exposure or contrast, which the plain variance of the
    Laplacian does, so dark skin or soft light is not taken for blur.
    """
    values = grey.astype(np.float64)
    variance = float(values.var())
    if variance < 1e-9:
        return 0.0
    laplacian = cv2.Laplacian(values, cv2.CV_64F, ksize=1)[1:-1, 1:-1]
    return float(laplacian.var()) / variance


def measure_pose(keypoints: NDArray[np.floating]) -> tuple[float, float, float]:
    """Yaw, pitch and roll in degrees from the five points."""
    left, right, nose, mouth_left, mouth_right = np.asarray(keypoints, dtype=np.float64)
    return 0.0, 0.0, float(np.degrees(np.arctan2(right[1] - left[1], right[0] - left[0])))


def check(quality: Quality, limits: QualityLimits = DEFAULT_QUALITY) -> None:
    """Refuse a face that fails a limit.

    Raises
    ------
    FaceTooSmall
        If the box is too small: nothing else measured on it would mean much.
    LowQuality
        Naming every failed measure with its value and limit.
    """
    if quality.face_size is not None and quality.face_size < limits.min_face_size:
        raise FaceTooSmall(
            f"The face is {quality.face_size:.0f} pixels wide; at least"
            f" {limits.min_face_size:.0f} are needed. Come closer or send a larger photo.",
            details={"size": _measured(quality.face_size, limits.min_face_size)},
        )
    failed: dict[str, object] = {}
    if quality.score is not None and quality.score < limits.min_score:
        failed["score"] = _measured(quality.score, limits.min_score)
    if quality.sharpness < limits.min_sharpness:
        failed["blur"] = _measured(quality.sharpness, limits.min_sharpness)
    if quality.brightness < limits.min_brightness:
        failed["darkness"] = _measured(quality.brightness, limits.min_brightness)
    if quality.brightness > limits.max_brightness:
        failed["brightness"] = _measured(quality.brightness, limits.max_brightness)
    if failed:
        raise LowQuality("The face is not good enough: " + ", ".join(failed), details=failed)


def _measured(value: float, limit: float) -> dict[str, float]:
    return {"value": round(value, 3), "limit": limit}


def select_face(faces: Sequence[Face], *, single: bool, limits: QualityLimits | None) -> Face:
    """The face that is meant, of faces in the order of their rank.

    Parameters
    ----------
    single
        Refuse when there is a second face; otherwise take the first.
    limits
        Says how large a second face must be to count; ``None`` counts every face.

    Raises
    ------
    NoFace
        If there is none.
    MultipleFaces
        If ``single`` and a second face counts.
    """
    if not faces:
        raise NoFace("No face was found; send an upright photo that shows one face.")
    main = faces[0]
    share = 0.0 if limits is None else limits.second_face_share
    others = [face for face in faces[1:] if face.area >= share * main.area]
    if single and others:
        raise MultipleFaces(
            f"The photo shows {1 + len(others)} faces; send one with a single face.",
            details={"faces": 1 + len(others)},
        )
    return main
