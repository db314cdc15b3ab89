"""Heads and flat pictures of heads as points in space, and the camera that sees them.

Millimetres; x to the right of the picture, y down, z towards the camera, which stands ``distance``
in front of the middle of the head.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

# Means of adults: eyes 63 apart, mouth 50 wide and 68 below the eyes, the tip of the nose 25 in
# front of their plane. Eyes and mouth corners are not quite in one plane.
HEAD: Points = np.array(
    [
        [-31.5, -34.0, -2.0],
        [31.5, -34.0, -2.0],
        [0.0, 3.0, 25.0],
        [-25.0, 34.0, 2.0],
        [25.0, 34.0, 2.0],
    ]
)
FOCAL = 800.0
SIZE = 640


def turned(points: Points, *, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Points:
    """Turn points about the origin by degrees: signs as those of a head's pose."""
    a, b, c = np.radians([yaw, pitch, roll])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), np.sin(b)], [0, -np.sin(b), np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return points @ (about_z @ about_x @ about_y).T


def seen(points: Points, *, distance: float = 500.0, at: tuple[float, float] = (0, 0)) -> Points:
    """What a pinhole camera sees, (5, 2), in pixels of a square picture."""
    x, y, z = points.T
    return FOCAL * np.stack([x + at[0], y + at[1]], axis=1) / (distance - z)[:, None] + SIZE / 2


def head(*, distance: float = 500.0, at: tuple[float, float] = (0, 0), **angles: float) -> Points:
    """Five points of a turned head."""
    return seen(turned(HEAD, **angles), distance=distance, at=at)


def photo(
    *,
    of: dict[str, float] | None = None,
    bent_to: float | None = None,
    distance: float = 500.0,
    at: tuple[float, float] = (0, 0),
    **angles: float,
) -> Points:
    """Five points of a printed, life-size photo of a head, turned as a sheet is.

    Parameters
    ----------
    of
        Angles of the head when the photo was taken, from afar.
    bent_to
        Radius in mm of the upright cylinder that the sheet is bent around; flat by default.
    """
    sheet = turned(HEAD, **(of or {})) * [1, 1, 0]
    if bent_to is not None:
        angle = sheet[:, 0] / bent_to
        sheet[:, 0], sheet[:, 2] = bent_to * np.sin(angle), bent_to * (np.cos(angle) - 1)
    return seen(turned(sheet, **angles), distance=distance, at=at)


POSES: dict[str, dict[str, float]] = {
    "front": {},
    "turn_left": {"yaw": 30.0},
    "turn_right": {"yaw": -30.0},
    "look_up": {"pitch": -22.0},
    "look_down": {"pitch": 22.0},
    "come_closer": {"distance": 350.0},
}
"""Poses of a person who does as told, by the names of movements."""


def performed(movements: Sequence[str]) -> list[str]:
    """Names of the poses in eight frames: the front, and each movement and the front again."""
    return ["front", *(name for movement in movements for name in (movement, "front"))]
