"""Synthetic faces: drawn people who do not exist, for the demo and for tests without data.

A face is drawn from twelve numbers that depend on ``identity`` alone; each photo of it adds what a
camera and a living face add (light, a small pose, a smile, blur, noise, background), from numbers
that depend on ``identity`` and ``photo``. The picture is aligned as a detector would align it: the
eyes and the mouth stand where the 112 x 112 ArcFace template has them.

These are cartoons. An embedding that tells them apart says nothing about real faces.
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Points = NDArray[np.float64]
Colour = tuple[int, int, int]

_SHIFT = 4  # OpenCV draws at 1/16 pixel, so that small differences of shape are seen
_CANVAS = 224  # drawn at twice the template's size, then reduced by area
_SKIN = ((255, 224, 196), (84, 54, 40))


@dataclass(frozen=True)
class Person:
    """What stays the same in all photos of one identity, each a number from 0 to 1."""

    skin: float
    """From light to dark."""
    beard: float
    """Without below 0.5, then longer and longer."""
    face_width: float
    chin: float
    fringe: float
    parting: float
    eye_height: float
    brow_height: float
    brow_tilt: float
    nose: float
    mouth: float
    glasses: float
    """Without below 0.4, then larger and larger."""


def draw_person(identity: int) -> Person:
    """Return the twelve numbers of a synthetic person."""
    shares = np.random.default_rng([identity, 0]).random(len(fields(Person)))
    return Person(*shares.tolist())


def draw_face(identity: int, photo: int = 0, *, size: int = 112) -> NDArray[np.uint8]:
    """One photo of one synthetic person.

    Examples
    --------
    >>> draw_face(7, 0).shape
    (112, 112, 3)
    """
    rng = np.random.default_rng([identity, 1, photo])
    canvas = _posed(_drawn(draw_person(identity), rng), rng)
    picture = cv2.resize(canvas, (size, size), interpolation=cv2.INTER_AREA)
    return _exposed(np.asarray(picture, np.uint8), rng)


def draw_people(identities: range, photos: range, *, size: int = 112) -> NDArray[np.uint8]:
    """All ``photos`` of all ``identities``: uint8 (len(identities) * len(photos), size, size, 3).

    Photos of one person follow one another.
    """
    return np.stack([draw_face(i, p, size=size) for i in identities for p in photos])


def encode_photo(picture: NDArray[np.uint8]) -> bytes:
    """Encode an RGB picture, uint8 (h, w, 3), as a PNG file."""
    return cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))[1].tobytes()


def _drawn(person: Person, rng: Generator) -> NDArray[np.uint8]:
    """The person before the camera; lengths are in pixels of the 112 x 112 template."""
    background, shirt = rng.integers(40, 216, (2, 3)).tolist()
    canvas = np.full((_CANVAS, _CANVAS, 3), background, np.uint8)
    skin = _mixed(*_SKIN, person.skin)
    shade, hair = _mixed(skin, (40, 20, 20), 0.35), _mixed(skin, (20, 16, 16), 0.8)
    width, chin = _between(34, 48, person.face_width), _between(100, 119, person.chin)
    _fill(canvas, _oval(56, 116, 56, 16), shirt)
    _fill(canvas, _oval(56, 104, 22, 14), shade)
    _fill(canvas, _oval(56, 50, width + 6, 56), hair)
    jaw, forehead = _oval(56, 58, width, chin - 58)[:25], _oval(56, 58, width, 52)[24:]
    _fill(canvas, np.concatenate([jaw, forehead]), skin)
    if person.beard > 0.5:
        _fill(canvas, jaw[jaw[:, 1] > chin - _between(5, 25, 2 * person.beard - 1)], hair)
    low, part = _between(14, 38, person.fringe), 56 + _between(-30, 30, person.parting)
    fringe = [[0, -8], [112, -8], [57 + width, low + 12], [part, low - 8], [55 - width, low + 12]]
    _fill(canvas, np.array(fringe, np.float64), hair)
    for side in (-1, 1):
        _draw_eye(canvas, person, side, 1 + _around(rng, 0.18), shade, hair)
    _draw_nose(canvas, person.nose, shade)
    _draw_mouth(canvas, person.mouth, smile=_around(rng, 1.8))
    return canvas


def _draw_eye(
    canvas: NDArray[np.uint8],
    person: Person,
    side: int,
    lids: float,
    outline: Colour,
    brow: Colour,
) -> None:
    x, y = 56 + side * 17.6, 51.6
    height = _between(2, 5.5, person.eye_height) * lids
    eye = _oval(x, y, 7.5, height)
    _fill(canvas, eye, (245, 245, 240))
    _fill(canvas, _oval(x, y, min(height, 3), min(height, 3)), (40, 30, 30))
    _stroke(canvas, np.vstack([eye, eye[:1]]), outline, 1)
    t = np.linspace(-1, 1, 9)
    tilt = side * _between(-3.5, 3.5, person.brow_tilt)
    arch = y - _between(8, 16, person.brow_height) + tilt * t - 2 * (1 - t**2)
    _stroke(canvas, np.stack([x + 9 * t, arch], axis=1), brow, 2.5)
    if person.glasses > 0.4:
        large = (person.glasses - 0.4) / 0.6
        rim = _oval(x, y + 1, _between(9, 15, large), _between(5, 14, large))
        _stroke(canvas, np.vstack([rim, rim[:1]]), (20, 20, 24), 1.5)


def _draw_nose(canvas: NDArray[np.uint8], share: float, colour: Colour) -> None:
    half, tip = _between(3.5, 11, share), _between(66, 76, share)
    t = np.linspace(-1, 1, 9)
    _stroke(canvas, np.stack([56 + half * t, tip + 1.5 - 2.5 * t**2], axis=1), colour, 1.5)
    _stroke(canvas, np.array([[56 - half * 0.4, 54], [56 - half, tip]]), colour, 1)


def _draw_mouth(canvas: NDArray[np.uint8], share: float, *, smile: float) -> None:
    half, lips = _between(9, 21, share), _between(6, 2.5, share)
    t = np.linspace(-1, 1, 17)
    x, line, arch = 56 + half * t, 92.3 - smile * t**2, 1 - t**2
    upper, lower = np.stack([x, line - lips * 0.7 * arch], 1), np.stack([x, line + lips * arch], 1)
    _fill(canvas, np.concatenate([upper, lower[::-1]]), (170, 60, 70))
    _stroke(canvas, np.stack([x, line], axis=1), (60, 16, 22), 0.8)


def _posed(canvas: NDArray[np.uint8], rng: Generator) -> NDArray[np.uint8]:
    """Small shift, roll and zoom, and a turn of the head as a horizontal perspective."""
    side = canvas.shape[0]
    middle = (side / 2, side / 2)
    matrix = np.eye(3)
    matrix[:2] = cv2.getRotationMatrix2D(middle, _around(rng, 1.5), 1 + _around(rng, 0.02))
    matrix[:2, 2] += [_around(rng, side / 160), _around(rng, side / 160)]
    turn = _around(rng, 0.03)
    yaw = np.array([[1, 0, 0], [0, 1, 0], [turn / side, 0, 1 - turn / 2]])
    warped = cv2.warpPerspective(
        canvas, yaw @ matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(warped, np.uint8)


def _exposed(picture: NDArray[np.uint8], rng: Generator) -> NDArray[np.uint8]:
    """Light from a side, gain and gamma, blur and the noise of a sensor."""
    side = picture.shape[0]
    light = np.linspace(-0.5, 0.5, side, dtype=np.float32)
    field = 1 + _around(rng, 0.22) * light[None, :] + _around(rng, 0.15) * light[:, None]
    values = (picture.astype(np.float32) / 255) ** np.float32(1 + _around(rng, 0.2))
    values *= (field * (1 + _around(rng, 0.22)))[:, :, None]
    values[:] = cv2.GaussianBlur(values, (0, 0), (0.2 + 0.5 * rng.random()) * side / 112)
    noise = (1 + 3 * rng.random()) * rng.standard_normal(values.shape, dtype=np.float32)
    return np.clip(np.round(values * 255 + noise), 0, 255).astype(np.uint8)


def _around(rng: Generator, spread: float) -> float:
    return float(spread * (2 * rng.random() - 1))


def _between(low: float, high: float, share: float) -> float:
    return low + (high - low) * share


def _mixed(a: Colour, b: Colour, share: float) -> Colour:
    red, green, blue = (round(_between(x, y, share)) for x, y in zip(a, b, strict=True))
    return red, green, blue


def _oval(x: float, y: float, width: float, height: float) -> Points:
    """Trace an ellipse of half-axes ``width`` and ``height``: float64 (48, 2), downward first."""
    t = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return np.stack([x + width * np.cos(t), y + height * np.sin(t)], axis=1)


def _fill(canvas: NDArray[np.uint8], points: Points, colour: Colour) -> None:
    cv2.fillPoly(canvas, [_grid(points)], colour, cv2.LINE_AA, _SHIFT)


def _stroke(canvas: NDArray[np.uint8], points: Points, colour: Colour, width: float) -> None:
    pixels = max(1, round(width * _CANVAS / 112))
    cv2.polylines(canvas, [_grid(points)], False, colour, pixels, cv2.LINE_AA, _SHIFT)


def _grid(points: Points) -> NDArray[np.int32]:
    scale = _CANVAS / 112 * (1 << _SHIFT)
    return np.asarray(np.round(points * scale), np.int32).reshape(-1, 1, 2)
