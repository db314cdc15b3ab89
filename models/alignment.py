"""Warp a face onto the common five-point template of ArcFace."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.errors import PackError

# Left eye, right eye, nose, left and right mouth corner as the viewer sees them, for 112 x 112
# (docs/models.md "Detection and alignment").
TEMPLATE_112: NDArray[np.float64] = np.array(
    [
        [38.2946, 51.6963],
        [73.5318, 51.5014],
        [56.0252, 71.7366],
        [41.5493, 92.3655],
        [70.7299, 92.2041],
    ],
    dtype=np.float64,
)
TEMPLATE_NAME = "arcface-112"


def template(size: int) -> NDArray[np.float64]:
    """Five points of the template, (5, 2) float64, in pixels of a ``size`` x ``size`` crop."""
    if size > 0 and size % 112 == 0:
        return np.asarray(TEMPLATE_112 * (size / 112))
    if size > 0 and size % 128 == 0:
        ratio = size / 128
        return np.asarray(TEMPLATE_112 * ratio + np.array([8 * ratio, 0.0]))
    raise PackError(
        f"There is no common alignment template for a {size} x {size} embedder; sizes are"
        " multiples of 112 or of 128."
    )


def similarity_transform(source: ArrayLike, target: ArrayLike) -> NDArray[np.float64]:
    """Least-squares similarity (rotation, uniform scale, translation; no shear, no mirror).

    Of corresponding points, (k, 2), not all equal: ``target ≈ M[:, :2] @ source + M[:, 2]``.

    In the plane Umeyama's problem has a closed form: with points as complex numbers it is the
    regression ``w = a z + b`` with one complex slope, whose modulus is the scale and whose
    argument the rotation.

    References
    ----------
    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns,
    IEEE TPAMI 13(4), 1991.
    """
    z = np.asarray(source, dtype=np.float64) @ np.array([1, 1j])
    w = np.asarray(target, dtype=np.float64) @ np.array([1, 1j])
    z_mean, w_mean = z.mean(), w.mean()
    z_centred = z - z_mean
    power = float(np.vdot(z_centred, z_centred).real)
    if not np.isfinite(power) or power <= 0.0:
        raise ValueError("the source points must be finite and not all equal")
    a = complex(np.vdot(z_centred, w - w_mean)) / power
    b = complex(w_mean - a * z_mean)
    return np.array([[a.real, -a.imag, b.real], [a.imag, a.real, b.imag]])


def align(
    image: NDArray[np.uint8], keypoints: NDArray[np.floating], *, size: int
) -> NDArray[np.uint8]:
    """Crop a face so that its five points, (5, 2), lie on the template: bilinear, 0 outside."""
    matrix = similarity_transform(keypoints, template(size))
    crop = cv2.warpAffine(
        image, matrix, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    return np.ascontiguousarray(crop, dtype=np.uint8)
