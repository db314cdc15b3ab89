"""Which face of a photo is meant, where it shows several."""

from collections.abc import Sequence
from enum import StrEnum

from models.boxes import Face
from models.errors import MultipleFaces, NoFace

# Least area of the face that is meant over that of every other face. Measured in
# docs/results/photos.md.
DOMINANCE = 2.0
LARGER = 1.25


class FacePolicy(StrEnum):
    """What a photo with several faces means."""

    DOMINANT = "dominant"
    """The largest face, in the middle of the picture and ``DOMINANCE`` times any other's area."""
    LARGEST = "largest"
    """The largest face, wherever it is, of ``LARGER`` times any other's area: not by a hair."""
    SINGLE = "single"
    """None of them: a second face refuses the photo."""


def select_face(
    faces: Sequence[Face],
    policy: FacePolicy | None,
    *,
    shape: tuple[int, ...],
    min_size: float = 0.0,
) -> Face:
    """Return the face that is meant."""
    if not faces:
        raise NoFace(
            "No face was found: hold the photo upright, and come closer, until the face fills a "
            "good part of it."
        )
    if policy is None:
        return faces[0]
    by_area = sorted(faces, key=lambda face: face.area, reverse=True)
    counted = [face for face in by_area if min(face.width, face.height) >= min_size]
    main, *others = counted or by_area[:1]
    if not others:
        return main
    ratio = main.area / others[0].area
    match policy:
        case FacePolicy.DOMINANT if ratio >= DOMINANCE and _covers_middle(main, shape):
            return main
        case FacePolicy.LARGEST if ratio >= LARGER:
            return main
    raise MultipleFaces(
        f"The photo shows {len(counted)} faces{_REMEDIES[policy]}", details={"faces": len(counted)}
    )


def _covers_middle(face: Face, shape: tuple[int, ...]) -> bool:
    x1, y1, x2, y2 = face.box
    return bool(x1 <= shape[1] / 2 <= x2 and y1 <= shape[0] / 2 <= y2)


_REMEDIES = {
    FacePolicy.DOMINANT: ", and none of them is both in the middle and much the largest: come "
    "closer, or send face=largest to take the largest face wherever it is.",
    FacePolicy.LARGEST: ", and the largest two are of about the same size: cut the photo to one.",
    FacePolicy.SINGLE: "; send one that shows a single face.",
}
