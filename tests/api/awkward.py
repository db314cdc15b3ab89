"""Pictures that show something else than one usable face, with the codes of a refusal."""

import io
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter


@dataclass(frozen=True)
class Case:
    name: str
    data: bytes = field(repr=False)
    codes: frozenset[str]


def encode(pixels: NDArray[np.uint8], form: str, **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, form, **options)
    return out.getvalue()


def scenes(photo: NDArray[np.uint8], other: NDArray[np.uint8]) -> Iterator[Case]:
    """Pictures that are in order, and show something else than one usable face."""
    height, width = photo.shape[:2]
    canvas = np.full((3 * height, 3 * width, 3), 127, np.uint8)

    def paste(*places: tuple[NDArray[np.uint8], int, int]) -> NDArray[np.uint8]:
        scene = canvas.copy()
        for face, y, x in places:
            scene[y : y + face.shape[0], x : x + face.shape[1]] = face
        return scene

    several = frozenset({"multiple_faces"})
    for name, scene in (
        ("two people side by side", np.concatenate([photo, other], axis=1)),
        ("two people one above the other", np.concatenate([photo, other], axis=0)),
        ("one person twice", np.concatenate([photo, photo], axis=1)),
        ("three people", np.concatenate([photo, other, photo], axis=1)),
        ("two people far apart", paste((photo, 0, 0), (other, 2 * height, 2 * width))),
        ("a crowd of nine", np.tile(np.concatenate([photo, other, photo], axis=1), (3, 1, 1))),
    ):
        yield Case(name, encode(scene, "JPEG", quality=95), several)
    nobody = frozenset({"no_face"})
    rng = np.random.default_rng(3)
    for name, scene in (
        ("black", np.zeros((300, 300, 3), np.uint8)),
        ("white", np.full((300, 300, 3), 255, np.uint8)),
        ("grey", np.full((300, 300, 3), 127, np.uint8)),
        ("noise", rng.integers(0, 256, (300, 300, 3), dtype=np.uint8)),
        ("stripes", np.tile(np.uint8([[0], [255]])[:, :, None], (150, 300, 3))),
        (
            "a gradient",
            np.tile(np.linspace(0, 255, 300, dtype=np.uint8)[:, None, None], (1, 300, 3)),
        ),
        ("one pixel", np.zeros((1, 1, 3), np.uint8)),
        ("a line", np.zeros((1, 500, 3), np.uint8)),
        ("a column", np.zeros((500, 1, 3), np.uint8)),
        ("a strip", np.zeros((8, 4000, 3), np.uint8)),
    ):
        yield Case(name, encode(np.ascontiguousarray(scene), "PNG"), nobody)
    small = np.asarray(Image.fromarray(photo).resize((50, 50)))
    yield Case(
        "a thumbnail",
        encode(small, "PNG"),
        frozenset({"face_too_small", "no_face", "low_quality"}),
    )
    low = frozenset({"low_quality"})
    dark = (photo.astype(np.float32) * 0.08).astype(np.uint8)
    yield Case("in the dark", encode(dark, "PNG"), low)
    blurred = np.asarray(Image.fromarray(photo).filter(ImageFilter.GaussianBlur(6)))
    yield Case("out of focus", encode(blurred, "PNG"), low)
    glare = np.clip(photo.astype(np.float32) * 0.05 + 243, 0, 255).astype(np.uint8)
    yield Case("in the glare", encode(glare, "PNG"), frozenset({"low_quality", "no_face"}))
