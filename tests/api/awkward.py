"""Malformed and awkward pictures, each with the codes that a service may answer."""

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

DAMAGED = frozenset({"unsupported_image"})
LARGE = frozenset({"image_too_large"})
READ_OR_REFUSED = frozenset(
    {"ok", "unsupported_image", "image_too_large", "no_face", "low_quality", "face_too_small"}
    | {"multiple_faces"}
)


@dataclass(frozen=True)
class Case:
    name: str
    data: bytes = field(repr=False)
    codes: frozenset[str]


def encode(pixels: NDArray[np.uint8], form: str, **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, form, **options)
    return out.getvalue()


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, *, depth: int = 8, colour: int = 2, body: bytes = b"") -> bytes:
    """A PNG whose header states any size, with little behind it."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    packed = zlib.compress(body or b"\x00" * 1000)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")
    )


def damaged(photo: NDArray[np.uint8]) -> Iterator[Case]:
    """Truncations and bit flips of each format."""
    rng = np.random.default_rng(2026)
    for form in ("JPEG", "PNG", "WEBP", "BMP"):
        whole = encode(photo, form)
        for share in (0.0, 0.001, 0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97):
            yield Case(f"{form} cut at {share:.1%}", whole[: int(len(whole) * share)], DAMAGED)
        for index in range(22):
            flipped = bytearray(whole)
            for place in rng.integers(0, len(whole), 1 + index):
                flipped[place] ^= 1 << int(rng.integers(8))
            yield Case(f"{form} with {1 + index} flipped bits", bytes(flipped), READ_OR_REFUSED)
        for index in range(6):
            block = bytearray(whole)
            start = int(rng.integers(20, len(whole) - 64))
            block[start : start + 64] = rng.bytes(64)
            yield Case(f"{form} with a block of noise {index}", bytes(block), READ_OR_REFUSED)
        yield Case(f"{form} behind noise", b"GARBAGE" + whole, DAMAGED)
        yield Case(f"{form} with a tail", whole + b"\x00" * 5000, READ_OR_REFUSED)


def no_pictures() -> Iterator[Case]:
    """Bytes that never were a picture that Veilface reads."""
    rng = np.random.default_rng(7)
    grey = np.full((64, 64, 3), 128, np.uint8)
    yield Case("empty", b"", DAMAGED)
    yield Case("one byte", b"\xff", DAMAGED)
    for size in (2, 16, 100, 10_000, 1_000_000):
        yield Case(f"{size} bytes of noise", rng.bytes(size), DAMAGED)
        yield Case(f"{size} zeros", b"\x00" * size, DAMAGED)
    for form in ("GIF", "TIFF", "PPM", "ICO", "TGA"):
        yield Case(form, encode(grey, form), DAMAGED)
    yield Case("SVG", b'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>', DAMAGED)
    yield Case("EPS", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", DAMAGED)
    yield Case("PDF", b"%PDF-1.4\n%%EOF", DAMAGED)
    yield Case("ZIP", b"PK\x03\x04" + b"\x00" * 100, DAMAGED)
    yield Case("pickle", b"\x80\x04cos\nsystem\n(S'true'\ntR.", DAMAGED)
    yield Case("path", b"/etc/passwd", DAMAGED)
    yield Case("URL", b"http://127.0.0.1/face.jpg", DAMAGED)
    for magic in (b"\xff\xd8\xff\xe0", b"\x89PNG\r\n\x1a\n", b"RIFF\xff\xff\xff\xffWEBPVP8 "):
        yield Case(f"only a signature {magic[:4]!r}", magic, DAMAGED)
        # Noise may state any size.
        noise = magic + rng.bytes(3000)
        yield Case(f"signature and noise {magic[:4]!r}", noise, DAMAGED | LARGE)


def bombs(max_pixels: int) -> Iterator[Case]:
    """Small files that state, or unpack to, a lot."""
    for width, height in ((65_535, 65_535), (2**31 - 1, 2**31 - 1), (2**31 - 1, 1), (1, 60_000)):
        yield Case(f"PNG of {width} x {height}", png(width, height), LARGE | DAMAGED)
    side = int(max_pixels**0.5) + 50
    yield Case("PNG just over the limit", encode(np.zeros((side, side, 3), np.uint8), "PNG"), LARGE)
    yield Case("JPEG over the limit", encode(np.zeros((side, side, 3), np.uint8), "JPEG"), LARGE)
    yield Case("WebP over the limit", encode(np.zeros((side, side, 3), np.uint8), "WEBP"), LARGE)
    yield Case("PNG that unpacks to much more", png(64, 64, body=b"\x00" * 50_000_000),
               READ_OR_REFUSED)  # fmt: skip
    text = chunk(b"zTXt", b"k\x00\x00" + zlib.compress(b"\x00" * 50_000_000))
    whole = png(64, 64, body=b"\x00" * (64 * 193))
    yield Case("PNG with a text bomb", whole[:33] + text + whole[33:], READ_OR_REFUSED)
    yield Case("PNG of no width", png(0, 64), DAMAGED)
    yield Case("PNG of no height", png(64, 0), DAMAGED)
    jpeg = bytearray(encode(np.zeros((64, 64, 3), np.uint8), "JPEG"))
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = b"\xff\xff\xff\xff"
    yield Case("JPEG that states 65535 x 65535", bytes(jpeg), LARGE)
    scans = encode(np.zeros((64, 64, 3), np.uint8), "JPEG", progressive=True)
    start, end = scans.index(b"\xff\xda"), scans.rindex(b"\xff\xd9")
    yield Case("JPEG of 5000 scans", scans[:start] + scans[start:end] * 5000 + b"\xff\xd9", DAMAGED)
    side = int(max_pixels**0.5)
    scans = encode(np.zeros((side, side, 3), np.uint8), "JPEG", progressive=True)
    start, end = scans.rindex(b"\xff\xc4"), scans.rindex(b"\xff\xd9")
    yield Case("JPEG of the most pixels in 90 scans", scans[:end] + scans[start:end] * 80
               + b"\xff\xd9", DAMAGED)  # fmt: skip
    frames = [Image.new("RGB", (64, 64), (i, i, i)) for i in range(8)]
    for form in ("PNG", "WEBP"):
        out = io.BytesIO()
        frames[0].save(out, form, save_all=True, append_images=frames[1:])
        yield Case(f"animated {form}", out.getvalue(), DAMAGED)


def unusual(photo: NDArray[np.uint8]) -> Iterator[Case]:
    """Whole pictures in forms that few programs expect; the face stays as it is."""
    image = Image.fromarray(photo)
    alpha = image.convert("RGBA")
    alpha.putalpha(255)
    sixteen = np.asarray(image.convert("L")).astype(np.uint16) * 257
    for name, form, options in (
        ("CMYK JPEG", "JPEG", {"image": image.convert("CMYK")}),
        ("grey JPEG", "JPEG", {"image": image.convert("L")}),
        ("grey PNG", "PNG", {"image": image.convert("L")}),
        ("grey and alpha PNG", "PNG", {"image": alpha.convert("LA")}),
        ("alpha PNG", "PNG", {"image": alpha}),
        ("alpha WebP", "WEBP", {"image": alpha}),
        ("palette PNG", "PNG", {"image": image.quantize(256)}),
        ("16-bit PNG", "PNG", {"image": Image.fromarray(sixteen)}),
        ("progressive JPEG", "JPEG", {"image": image, "progressive": True}),
        ("lossless WebP", "WEBP", {"image": image, "lossless": True}),
        ("interlaced PNG", "PNG", {"image": image, "optimize": True}),
        ("JPEG of quality 30", "JPEG", {"image": image, "quality": 30}),
        ("4:2:0 JPEG", "JPEG", {"image": image, "subsampling": 2}),
    ):
        picture: Image.Image = options.pop("image")  # type: ignore[assignment]
        out = io.BytesIO()
        picture.save(out, form, **options)
        yield Case(name, out.getvalue(), frozenset({"ok"}))
    for orientation in range(1, 9):
        yield Case(f"EXIF {orientation}", rotated(photo, orientation), frozenset({"ok"}))
    broken = image.copy()
    exif = Image.Exif()
    exif[0x0112] = 77
    out = io.BytesIO()
    broken.save(out, "JPEG", exif=exif)
    yield Case("EXIF orientation 77", out.getvalue(), frozenset({"ok"}))
    out = io.BytesIO()
    broken.save(out, "JPEG", exif=b"Exif\x00\x00" + b"\xff" * 2000)
    yield Case("EXIF of noise", out.getvalue(), frozenset({"ok"}))


# How a camera stores an upright scene for each orientation tag (CIPA DC-008, 4.6.4).
STORED = {
    1: None,
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


def rotated(photo: NDArray[np.uint8], orientation: int) -> bytes:
    """The photo as a camera held another way stores it, with the tag that says so."""
    image = Image.fromarray(photo)
    step = STORED[orientation]
    if step is not None:
        image = image.transpose(step)
    exif = Image.Exif()
    exif[0x0112] = orientation
    out = io.BytesIO()
    image.save(out, "JPEG", quality=95, exif=exif)
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
