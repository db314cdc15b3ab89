"""Synthetic faces: drawn people who do not exist, for the demo and for tests without data.

A face is drawn from about forty numbers that depend on ``identity`` alone (skin, skull, hair,
eyes, brows, nose, mouth, glasses, beard, marks); each photo of it adds what a camera and a living
face add (light, colour cast, small pose, expression, blur, noise, background), from numbers that
depend on ``identity`` and ``photo``. The picture is aligned as a detector would align it: the
eyes and the mouth stand where the 112 x 112 ArcFace template has them.

These are cartoons. An embedding that tells them apart says nothing about real faces.
"""

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from models.synthetic_people import Colour, Person, Shot, draw_person, draw_shot, mix

Points = NDArray[np.float64]

_SHIFT = 4  # OpenCV draws at 1/16 pixel, so that small differences of shape are seen
_UNIT = 1 << _SHIFT
_CANVAS = 224  # drawn at twice the template's size, then reduced by area


def draw_face(identity: int, photo: int = 0, *, size: int = 112) -> NDArray[np.uint8]:
    """One photo of one synthetic person.

    Parameters
    ----------
    identity : int
        Seed of the person, 0 or greater.
    photo : int
        Seed of the photo; another number is another photo of the same person.
    size : int
        Side of the picture in pixels, 16 to 1024. The ArcFace template is scaled with it.

    Returns
    -------
    uint8 (size, size, 3)
        RGB, aligned. The same arguments give the same bytes.

    Raises
    ------
    ValueError
        A negative seed, or a size out of range.

    Examples
    --------
    >>> draw_face(7, 0).shape
    (112, 112, 3)
    """
    if identity < 0 or photo < 0:
        raise ValueError("identity and photo are seeds: whole numbers from 0")
    if not 16 <= size <= 1024:
        raise ValueError(f"size must be 16 to 1024 pixels, got {size}")
    person = draw_person(np.random.default_rng([identity, 0]))
    stream = np.random.default_rng([identity, 1, photo])
    shot = draw_shot(stream)
    canvas = _draw(person, shot)
    canvas = _pose(canvas, shot)
    picture = cv2.resize(canvas, (size, size), interpolation=cv2.INTER_AREA)
    return _expose(np.asarray(picture, np.uint8), shot, stream)


def draw_people(identities: range, photos: range, *, size: int = 112) -> NDArray[np.uint8]:
    """All ``photos`` of all ``identities``: uint8 (len(identities) * len(photos), size, size, 3).

    Photos of one person follow one another.
    """
    return np.stack([draw_face(i, p, size=size) for i in identities for p in photos])


def encode_photo(picture: NDArray[np.uint8]) -> bytes:
    """Encode an RGB picture, uint8 (h, w, 3), as a PNG file."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))
    if not done:  # the encoder refuses only shapes that draw_face never makes
        raise ValueError("the picture cannot be encoded as PNG")
    return data.tobytes()


class _Pen:
    """Filled shapes on a canvas, in template pixels."""

    def __init__(self, canvas: NDArray[np.uint8]) -> None:
        self.canvas = canvas
        self._scale = canvas.shape[0] / 112 * _UNIT

    def fill(self, points: Points, colour: Colour) -> None:
        cv2.fillPoly(self.canvas, [self._grid(points)], colour, cv2.LINE_AA, _SHIFT)

    def stroke(self, points: Points, colour: Colour, width: float, *, closed: bool = False) -> None:
        pixels = max(1, round(width * self.canvas.shape[0] / 112))
        cv2.polylines(
            self.canvas, [self._grid(points)], closed, colour, pixels, cv2.LINE_AA, _SHIFT
        )

    def tint(self, points: Points, colour: Colour, share: float) -> None:
        """Fill with a see-through colour."""
        above = self.canvas.copy()
        cv2.fillPoly(above, [self._grid(points)], colour, cv2.LINE_AA, _SHIFT)
        cv2.addWeighted(above, share, self.canvas, 1 - share, 0, self.canvas)

    def _grid(self, points: Points) -> NDArray[np.int32]:
        return np.asarray(np.round(points * self._scale), np.int32).reshape(-1, 1, 2)


def _oval(
    x: float, y: float, width: float, height: float, *, power: float = 2.0, tilt: float = 0.0
) -> Points:
    """Trace a superellipse of half-axes ``width`` and ``height``: float64 (48, 2)."""
    t = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    c, s = np.cos(t), np.sin(t)
    px = width * np.sign(c) * np.abs(c) ** (2 / power)
    py = height * np.sign(s) * np.abs(s) ** (2 / power)
    cos, sin = np.cos(tilt), np.sin(tilt)
    return np.stack([x + cos * px - sin * py, y + sin * px + cos * py], axis=1)


def _head(person: Person) -> Points:
    """Outline the face: round above the eyes, squarer or more pointed below."""
    middle = 58.0
    upper = _oval(56, middle, person.face_width, middle - person.face_top)
    lower = _oval(56, middle, person.face_width, person.chin - middle, power=person.jaw)
    return np.concatenate([lower[:24], upper[24:]])


def _draw(person: Person, shot: Shot) -> NDArray[np.uint8]:
    canvas = np.empty((_CANVAS, _CANVAS, 3), np.uint8)
    canvas[:] = shot.background
    pen = _Pen(canvas)
    shade = mix(person.skin, (40, 20, 20), 0.25)
    pen.fill(
        np.array([[0, 112], [8, 108], [40, 100], [72, 100], [104, 108], [112, 112]]), shot.shirt
    )
    pen.fill(_oval(56, 104, 22, 14), shade)
    head = _head(person)
    _draw_hair_behind(pen, person)
    for side in (-1, 1):
        pen.fill(_oval(56 + side * person.face_width, 62, 5, 9), shade)
    pen.fill(head, person.skin)
    _draw_beard(pen, person, head)
    _draw_fringe(pen, person)
    _draw_cheeks_and_marks(pen, person)
    for side in (-1, 1):
        _draw_eye(pen, person, shot, side)
    _draw_nose(pen, person)
    _draw_mouth(pen, person, shot)
    _draw_glasses(pen, person)
    return canvas


def _draw_hair_behind(pen: _Pen, person: Person) -> None:
    width = person.face_width + max(0.0, person.sides)
    top = person.face_top - 8
    lower = person.hair_length
    if person.sides <= 0:
        return
    pen.fill(_oval(56, (top + lower) / 2, width, (lower - top) / 2, power=3.0), person.hair)


def _draw_fringe(pen: _Pen, person: Person) -> None:
    low = person.face_top + person.hairline * 0.75
    edge = person.face_width + 2
    split = 56 + person.parting
    pen.fill(
        np.array(
            [
                [56 - edge, -8],
                [56 + edge, -8],
                [56 + edge, low + 16],
                [56 + edge - 6, low + 4],
                [(split + 56 + edge) / 2, low],
                [split, low - 8],
                [(split + 56 - edge) / 2, low],
                [56 - edge + 6, low + 4],
                [56 - edge, low + 16],
            ]
        ),
        person.hair,
    )


def _draw_beard(pen: _Pen, person: Person, head: Points) -> None:
    if person.beard:
        jaw = head[head[:, 1] > 66]
        inner = _oval(56, 66, person.face_width * 0.7, 17)
        inner = inner[inner[:, 1] > 66]
        cover = np.concatenate([jaw[np.argsort(jaw[:, 0])], inner[np.argsort(-inner[:, 0])]])
        pen.tint(cover, person.hair, person.beard)
    if person.goatee:
        pen.fill(_oval(56, person.chin - 8, person.goatee, 7), person.hair)


def _draw_cheeks_and_marks(pen: _Pen, person: Person) -> None:
    for side in (-1, 1):
        if person.cheeks:
            pen.tint(_oval(56 + side * 22, 74, 9, 7), (220, 70, 70), person.cheeks)
        if person.bags:
            pen.tint(_oval(56 + side * person.eye_gap, 58, 8, 3.5), (70, 30, 50), person.bags)
    for x, y, radius in person.marks:
        pen.fill(_oval(x, y, radius, radius), mix(person.skin, (30, 10, 10), 0.75))


def _draw_eye(pen: _Pen, person: Person, shot: Shot, side: int) -> None:
    x, y = 56 + side * person.eye_gap, 51.6
    tilt = side * person.eye_tilt
    height = person.eye_height * shot.lids
    eye = _oval(x, y, person.eye_width, height, power=1.8, tilt=tilt)
    pen.fill(eye, (245, 245, 240))
    iris = min(height * 0.95, 3.4)
    pen.fill(_oval(x, y, iris, iris), person.iris)
    pen.fill(_oval(x, y, iris * 0.5, iris * 0.5), (8, 8, 8))
    pen.stroke(eye, mix(person.skin, (20, 10, 10), 0.7), 0.7, closed=True)
    t = np.linspace(-1, 1, 9)
    brow_y = y - person.brow_height - shot.brow_raise
    xs = x + side * t * person.brow_length
    ys = brow_y + t * person.brow_tilt * person.brow_length * 0.6 - person.brow_arch * (1 - t**2)
    pen.stroke(
        np.stack([xs, ys], axis=1), mix(person.hair, (20, 16, 16), 0.3), person.brow_thickness
    )


def _draw_nose(pen: _Pen, person: Person) -> None:
    tip = 51.6 + person.nose_length
    half = person.nose_width
    dark = mix(person.skin, (50, 20, 20), 0.45)
    bridge = np.array(
        [[56 - half * 0.4, 52], [56 + half * 0.15, 52], [56 - half * 0.2, tip], [56 - half, tip]]
    )
    pen.tint(bridge, dark, person.nose_bridge)
    t = np.linspace(-1, 1, 9)
    pen.stroke(np.stack([56 + half * t, tip + 1.5 - 2.5 * t**2], axis=1), dark, 1.1)
    for side in (-1, 1):
        pen.fill(_oval(56 + side * half * 0.5, tip, 1.4, 0.9), mix(person.skin, (20, 5, 5), 0.7))


def _draw_mouth(pen: _Pen, person: Person, shot: Shot) -> None:
    y = 92.3 + person.mouth_drop - 1.5
    t = np.linspace(-1, 1, 17)
    xs = 56 + person.mouth_width * (1 + 0.05 * shot.smile) * t
    line = y - shot.smile * t**2
    arch = 1 - t**2
    upper = line - person.upper_lip * arch * (1 - 0.35 * np.exp(-((t / 0.15) ** 2)))
    lower = line + shot.mouth_open * arch + person.lower_lip * arch
    pen.fill(
        np.concatenate([np.stack([xs, upper], 1), np.stack([xs, lower], 1)[::-1]]), person.lips
    )
    inside = np.concatenate(
        [np.stack([xs, line], 1), np.stack([xs, line + shot.mouth_open * arch], 1)[::-1]]
    )
    pen.fill(inside, (60, 16, 22))
    pen.stroke(np.stack([xs, line], 1), mix(person.lips, (30, 0, 0), 0.6), 0.7)
    if person.moustache:
        above = y - person.upper_lip - 1.0
        ends = above - person.moustache * arch
        shape = [np.stack([xs, np.full_like(xs, above)], 1), np.stack([xs, ends], 1)[::-1]]
        pen.fill(np.concatenate(shape), person.hair)


def _draw_glasses(pen: _Pen, person: Person) -> None:
    if not person.glasses:
        return
    power = {1: 2.0, 2: 5.0, 3: 3.0}[person.glasses]
    high = person.glasses_size * {1: 1.0, 2: 0.65, 3: 0.8}[person.glasses]
    for side in (-1, 1):
        rim = _oval(56 + side * 19.5, 53, person.glasses_size, high, power=power)
        pen.tint(rim, (225, 235, 245), 0.12)
        pen.stroke(rim, person.frame, person.glasses_weight, closed=True)
        inner = 56 + side * (19.5 - person.glasses_size)
        outer = 56 + side * (19.5 + person.glasses_size)
        temple = 56 + side * (person.face_width + 4)
        pen.stroke(np.array([[56.0, 51.0], [inner, 52.0]]), person.frame, person.glasses_weight)
        pen.stroke(np.array([[outer, 52.0], [temple, 54.0]]), person.frame, person.glasses_weight)


def _pose(canvas: NDArray[np.uint8], shot: Shot) -> NDArray[np.uint8]:
    """Small shift, roll and zoom, and a turn of the head as a horizontal perspective."""
    side = canvas.shape[0]
    scale = side / 112
    matrix = np.vstack(
        [cv2.getRotationMatrix2D((side / 2, side / 2), shot.turn, shot.zoom), [0, 0, 1]]
    )
    matrix[0, 2] += shot.shift[0] * scale
    matrix[1, 2] += shot.shift[1] * scale
    yaw = np.array([[1, 0, 0], [0, 1, 0], [shot.yaw / side, 0, 1 - shot.yaw / 2]])
    warped = cv2.warpPerspective(
        canvas, yaw @ matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(warped, np.uint8)


def _expose(picture: NDArray[np.uint8], shot: Shot, rng: Generator) -> NDArray[np.uint8]:
    side = picture.shape[0]
    light = np.linspace(-0.5, 0.5, side, dtype=np.float32)
    field = 1 + shot.side_light[0] * light[None, :] + shot.side_light[1] * light[:, None]
    values = (picture.astype(np.float32) / 255) ** np.float32(shot.gamma)
    values *= (shot.gain * field)[:, :, None] * np.asarray(shot.cast, np.float32)
    if shot.blur > 0.2:
        values[:] = cv2.GaussianBlur(values, (0, 0), shot.blur * side / 112)
    values = values * 255 + shot.noise * rng.standard_normal(values.shape, dtype=np.float32)
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
