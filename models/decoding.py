"""Bytes of an untrusted picture → upright RGB pixels, or an `ImageError`.

Pillow parses; this module decides what it may parse. The format is read from the content, the
limits are checked on the header before a pixel is decoded, and whatever a parser raises on
hostile bytes leaves as an `ImageError`.
"""

import io
import threading
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from models.errors import ImageError

FORMATS = ("JPEG", "PNG", "WEBP")
# An MPO file is a JPEG that carries further pictures (portrait mode of many phones); Pillow's
# JPEG reader names it so. The first picture is the photo.
_READ_AS = {"JPEG": "JPEG", "MPO": "JPEG", "PNG": "PNG", "WEBP": "WebP"}

# Transparent pixels are laid over white, the background of identity photos.
BACKGROUND = 255

# Every scan of a progressive JPEG walks over the whole picture, so a small file with thousands of
# scans keeps a core busy for minutes. Encoders write about ten.
MAX_JPEG_SCANS = 100

# Pillow reports odd metadata through `warnings`. The filters of that module are shared by all
# threads, so they are changed under a lock, and only while metadata is read.
_metadata_lock = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class ImageLimits:
    """What a picture may cost before its pixels are decoded.

    Attributes
    ----------
    max_bytes
        Size of the encoded picture. 10 MiB holds a 40 MP JPEG of a phone.
    max_pixels
        Width times height as the header states them.
    max_side
        Longer side in pixels.
    """

    max_bytes: int = 10 * 2**20
    max_pixels: int = 40_000_000
    max_side: int = 16_384


DEFAULT_LIMITS = ImageLimits()


def decode_image(data: bytes, *, limits: ImageLimits = DEFAULT_LIMITS) -> NDArray[np.uint8]:
    """Decode a JPEG, PNG or WebP picture.

    The EXIF orientation is applied. Greyscale, palette, CMYK and 16-bit pictures are converted
    to 8-bit RGB (16 bits are scaled by 255/65535, not clipped); transparency is laid over white.
    Animated pictures are refused: which frame was meant is not known.

    Parameters
    ----------
    data
        The encoded picture. Its name and declared type do not matter.
    limits
        Bytes, pixels and sides, checked before pixels are decoded.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        RGB, upright, C-contiguous.

    Raises
    ------
    ImageError
        With code ``image_too_large`` or ``unsupported_image``. Nothing else escapes, whatever
        the bytes.
    """
    if len(data) == 0:
        raise ImageError("unsupported_image", "The picture is empty: it has no bytes.")
    if len(data) > limits.max_bytes:
        raise ImageError(
            "image_too_large",
            f"The picture has {len(data)} bytes; at most {limits.max_bytes} are accepted.",
        )
    try:
        return _decode(data, limits)
    except ImageError:
        raise
    except Image.DecompressionBombError:
        raise ImageError(
            "image_too_large", "The picture states more pixels than the decoder accepts."
        ) from None
    except MemoryError:
        raise ImageError("image_too_large", "The picture does not fit into memory.") from None
    # Parsers of damaged files raise almost anything (struct.error, KeyError, TypeError, zlib.error
    # ...), so no narrower clause would hold. The cause is dropped: it may quote the bytes.
    except Exception:
        raise ImageError(
            "unsupported_image",
            "The picture is damaged or truncated; send a complete JPEG, PNG or WebP file.",
        ) from None


def _decode(data: bytes, limits: ImageLimits) -> NDArray[np.uint8]:
    _check_webp_canvas(data, limits)
    with _metadata_lock, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            image = Image.open(io.BytesIO(data), formats=FORMATS)
        except UnidentifiedImageError:
            raise ImageError(
                "unsupported_image", "The file is not a JPEG, PNG or WebP picture, or is damaged."
            ) from None
        _check_header(image, data, limits)
        if b"acTL" in data:  # the one chunk over which the pixel reader may warn
            image.load()
    with image:
        image.load()
        with _metadata_lock, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            orientation = _orientation(image)  # PNG may carry it behind the pixels
        pixels = _rgb(image)
    return np.ascontiguousarray(_upright(pixels, orientation))


def _check_webp_canvas(data: bytes, limits: ImageLimits) -> None:
    """Check the canvas that a WebP file declares; its decoder allocates it when it is opened."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or data[12:16] != b"VP8X" or len(data) < 30:
        # Sides of the simple forms have 14 bits; Pillow checks those before it allocates.
        return
    width = int.from_bytes(data[24:27], "little") + 1
    height = int.from_bytes(data[27:30], "little") + 1
    _check_size(width, height, limits)


def _check_size(width: int, height: int, limits: ImageLimits) -> None:
    if width <= 0 or height <= 0:
        raise ImageError("unsupported_image", f"The picture has no pixels ({width} x {height}).")
    if max(width, height) > limits.max_side or width * height > limits.max_pixels:
        raise ImageError(
            "image_too_large",
            f"The picture has {width} x {height} pixels; at most {limits.max_pixels} pixels and"
            f" {limits.max_side} on a side are accepted.",
        )


def _check_header(image: Image.Image, data: bytes, limits: ImageLimits) -> None:
    name = _READ_AS.get(image.format or "")
    if name is None:
        raise ImageError("unsupported_image", "The file is not a JPEG, PNG or WebP picture.")
    _check_size(image.width, image.height, limits)
    if name != "JPEG" and getattr(image, "is_animated", False):
        raise ImageError(
            "unsupported_image",
            f"The {name} file is animated; send a still picture, so that the frame is known.",
        )
    # Inside the coded pixels 0xFF is always followed by 0x00 or a restart marker, so this counts
    # scans (and those of an embedded thumbnail).
    if name == "JPEG" and data.count(b"\xff\xda") > MAX_JPEG_SCANS:
        raise ImageError(
            "unsupported_image", f"The JPEG file has more than {MAX_JPEG_SCANS} scans."
        )


def _orientation(image: Image.Image) -> int:
    """EXIF orientation 1...8; 1 where it is absent or unreadable, as viewers do."""
    try:
        value = image.getexif().get(0x0112, 1)
    # Broken EXIF does not make the picture unreadable, and its parser raises anything.
    except Exception:
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _rgb(image: Image.Image) -> NDArray[np.uint8]:
    if image.mode.startswith("I"):
        grey = np.asarray(image).astype(np.float32) * np.float32(255 / 65535)
        return np.repeat(np.rint(grey).clip(0, 255).astype(np.uint8)[:, :, None], 3, axis=2)
    if image.mode in ("LA", "PA", "RGBA", "La", "RGBa") or "transparency" in image.info:
        image = image.convert("RGBA")
        canvas = Image.new("RGBA", image.size, (BACKGROUND,) * 3 + (255,))
        canvas.alpha_composite(image)
        image = canvas
    return np.asarray(image.convert("RGB"), dtype=np.uint8)


def _upright(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Undo what EXIF tag 274 says the camera did (CIPA DC-008, 4.6.4)."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels
