"""What a synthetic person is made of, and what changes from photo to photo.

Lengths are in pixels of the 112 x 112 ArcFace template, angles of the drawn parts in radians.
"""

from dataclasses import dataclass

from numpy.random import Generator

Colour = tuple[int, int, int]

_SKIN = (
    (255, 224, 196),
    (240, 200, 165),
    (222, 175, 135),
    (190, 138, 98),
    (140, 92, 62),
    (84, 54, 40),
)
_HAIR = ((24, 20, 20), (58, 38, 28), (104, 66, 38), (160, 82, 40), (205, 165, 100), (170, 170, 175))
_IRIS = ((60, 36, 22), (96, 66, 34), (70, 96, 60), (80, 120, 160), (110, 120, 128))


@dataclass(frozen=True)
class Person:
    """What stays the same in all photos of one identity."""

    skin: Colour
    hair: Colour
    iris: Colour
    lips: Colour
    face_width: float
    face_top: float
    chin: float
    jaw: float
    hairline: float
    parting: float
    sides: float
    hair_length: float
    eye_gap: float
    eye_width: float
    eye_height: float
    eye_tilt: float
    brow_height: float
    brow_thickness: float
    brow_tilt: float
    brow_arch: float
    brow_length: float
    nose_length: float
    nose_width: float
    nose_bridge: float
    mouth_width: float
    upper_lip: float
    lower_lip: float
    mouth_drop: float
    beard: float
    moustache: float
    goatee: float
    glasses: int
    glasses_size: float
    glasses_weight: float
    frame: Colour
    cheeks: float
    bags: float
    marks: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Shot:
    """What differs from photo to photo of one identity."""

    smile: float
    mouth_open: float
    lids: float
    brow_raise: float
    shift: tuple[float, float]
    turn: float
    zoom: float
    yaw: float
    gain: float
    gamma: float
    side_light: tuple[float, float]
    cast: tuple[float, float, float]
    blur: float
    noise: float
    background: Colour
    shirt: Colour


def draw_person(rng: Generator) -> Person:
    """Make a person up."""

    def between(low: float, high: float) -> float:
        return float(low + (high - low) * rng.random())

    def chance(share: float, low: float, high: float) -> float:
        value = between(low, high)
        return value if rng.random() < share else 0.0

    skin = _jitter(rng, _blend(rng, _SKIN), 10)
    hair = _jitter(rng, _blend(rng, _HAIR), 12)
    return Person(
        skin=skin,
        hair=hair,
        iris=_jitter(rng, _blend(rng, _IRIS), 10),
        lips=mix(skin, (200, 50, 70), between(0.15, 0.75)),
        face_width=between(36, 48),
        face_top=between(2, 16),
        chin=between(101, 118),
        jaw=between(1.7, 3.6),
        hairline=between(2, 30),
        parting=between(-30, 30),
        sides=between(-4, 14),
        hair_length=between(35, 125),
        eye_gap=between(15.0, 20.5),
        eye_width=between(5.5, 9.5),
        eye_height=between(2.2, 5.2),
        eye_tilt=between(-0.22, 0.22),
        brow_height=between(8.0, 15.0),
        brow_thickness=between(0.8, 4.2),
        brow_tilt=between(-0.3, 0.3),
        brow_arch=between(-1.0, 4.5),
        brow_length=between(7.0, 12.5),
        nose_length=between(15, 25),
        nose_width=between(4.0, 10.5),
        nose_bridge=between(0.05, 0.35),
        mouth_width=between(10.0, 20.0),
        upper_lip=between(0.8, 3.8),
        lower_lip=between(1.2, 5.0),
        mouth_drop=between(-3.5, 4.5),
        beard=chance(0.3, 0.25, 0.95),
        moustache=chance(0.3, 1.5, 5.0),
        goatee=chance(0.2, 4.0, 10.0),
        glasses=int(rng.random() * 3) + 1 if rng.random() < 0.35 else 0,
        glasses_size=between(10.0, 15.0),
        glasses_weight=between(0.8, 2.6),
        frame=_jitter(
            rng,
            ((20, 20, 24), (120, 70, 30), (150, 30, 40), (170, 170, 180))[int(rng.random() * 4)],
            12,
        ),
        cheeks=chance(0.5, 0.05, 0.35),
        bags=chance(0.5, 0.1, 0.4),
        marks=tuple(
            (between(24, 88), between(34, 98), between(0.9, 2.2))
            for _ in range(int(rng.random() * 4))
        ),
    )


def draw_shot(rng: Generator) -> Shot:
    """Make one photo's circumstances up."""

    def around(spread: float) -> float:
        return float(spread * (2 * rng.random() - 1))

    def byte() -> int:
        return int(40 + rng.random() * 176)

    return Shot(
        smile=around(1.8),
        mouth_open=float(max(0.0, 5.0 * rng.random() - 2.5)),
        lids=1.0 + around(0.18),
        brow_raise=around(1.0),
        shift=(around(1.0), around(1.0)),
        turn=around(2.5),
        zoom=1.0 + around(0.025),
        yaw=around(0.04),
        gain=1.0 + around(0.22),
        gamma=1.0 + around(0.2),
        side_light=(around(0.22), around(0.15)),
        cast=(1.0 + around(0.06), 1.0 + around(0.06), 1.0 + around(0.06)),
        blur=float(0.9 * rng.random()),
        noise=1.0 + 4.0 * float(rng.random()),
        background=(byte(), byte(), byte()),
        shirt=(byte(), byte(), byte()),
    )


def _blend(rng: Generator, palette: tuple[Colour, ...]) -> Colour:
    """Pick a colour on the polyline through the palette."""
    place = rng.random() * (len(palette) - 1)
    left = int(place)
    return mix(palette[left], palette[left + 1], place - left)


def mix(a: Colour, b: Colour, share: float) -> Colour:
    """Go ``share`` of the way from one colour to another."""
    red, green, blue = (round(x + (y - x) * share) for x, y in zip(a, b, strict=True))
    return red, green, blue


def _jitter(rng: Generator, colour: Colour, spread: int) -> Colour:
    red, green, blue = (
        min(255, max(0, round(c + spread * (2 * rng.random() - 1)))) for c in colour
    )
    return red, green, blue
