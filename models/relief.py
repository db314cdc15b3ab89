"""Whether a face moved as a flat picture does, by what the pictures show and not by five points.

A detector puts its points on a covered face as if all of it were there, so a card that is pushed
over a photo moves them as a turn moves those of a head. What the picture shows of the photo has not
changed: one homography takes its details from one frame to the other. A head has relief, and no
homography does that for more than a part of its face.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

_SIDE = 224
_DETAILS = 600
_CONTRAST = 0.01
_EDGE = 20.0
_DISTINCT = 0.8
_WITHIN = 2.0
FLAT_SHARE = 0.5
"""Share of the matching details that one homography moves, at which the face is flat."""
FEWEST_MATCHES = 20
"""Matching details below which nothing can be said."""

Details = tuple[NDArray[np.float32], NDArray[np.float32]]


def details_of(crop: NDArray[np.uint8]) -> Details:
    """Find the details of a face that are found again in another picture of it (SIFT)."""
    grey = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (_SIDE, _SIDE), interpolation=cv2.INTER_CUBIC)
    sift = cv2.SIFT.create(nfeatures=_DETAILS, contrastThreshold=_CONTRAST, edgeThreshold=_EDGE)
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    places = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32).reshape(-1, 2)
    if not keypoints:
        return places, np.zeros((0, 128), dtype=np.float32)
    return places, np.asarray(descriptors, dtype=np.float32)


def shows_relief(first: Details, other: Details) -> bool:
    """Whether a face has moved between two pictures as no flat picture of it moves.

    Too few matching details show no relief: a blurred frame could hide a flat picture.

    Notes
    -----
    A detail matches where its nearest descriptor is at most 0.8 times as far as the second (Lowe,
    IJCV 2004). The homography is RANSAC's, within 2 of 224 pixels. The limits were set on drawn
    and on photographed heads: docs/liveness.md.
    """
    if min(len(first[0]), len(other[0])) < FEWEST_MATCHES:
        return False
    pairs = cv2.BFMatcher().knnMatch(first[1], other[1], k=2)
    matches = [best for best, second in pairs if best.distance < _DISTINCT * second.distance]
    if len(matches) < FEWEST_MATCHES:
        return False
    source = first[0][[match.queryIdx for match in matches]]
    target = other[0][[match.trainIdx for match in matches]]
    _, moved = cv2.findHomography(source, target, cv2.RANSAC, _WITHIN)
    return moved is None or float(np.mean(moved)) < FLAT_SHARE
