"""Bytes of an untrusted picture → upright RGB pixels, or an `ImageError`.

Pillow parses; this module decides what it may parse. The format is read from the content, the
limits are checked on the header before a pixel is decoded, and whatever a parser raises on
hostile bytes leaves as an `ImageError`.
"""

import hashlib
import io
import threading
import warnings
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from models.errors import ImageError
from models.file_kinds import unread_file
from models.lean import animated, jpeg_scans, lean

FORMATS = ("JPEG", "PNG", "WEBP", "BMP")
# A JPEG that carries further pictures (MPO, portrait mode of many phones) is read as the first
# one, the photo: the index of the others is not kept.
_READ_AS = {"JPEG": "JPEG", "PNG": "PNG", "WEBP": "WebP", "BMP": "BMP"}

SMALLER = "Send a smaller copy."

# Some programs forget the end marker. Pixels that are missing with it are made up of what follows,
# so that two endings give two pictures; where all are there, both give the same.
_JPEG_END = b"\xff\xd9"
_OTHER_END = bytes(range(254, 0, -1)) + _JPEG_END
# RLE8 and RLE4: Pillow unpacks them in Python, 24 megapixels of 20 kB in 7 seconds.
_BMP_RUNS = (1, 2)

# Transparent pixels are laid over white, the background of identity photos.
BACKGROUND = 255

# The most of any picture, however small. Encoders write about ten.
MAX_JPEG_SCANS = 100

# Pillow reports odd metadata through `warnings`. The filters of that module are shared by all
# threads, so they are changed under a lock, and only while metadata is read.
_metadata_lock = threading.Lock()


# Most bytes of memory that decoding takes for a pixel (measured: 7.2, 12.0 and 16.4). Pillow holds
# 4, the result 3. A progressive JPEG keeps its coefficients, 2 bytes a channel; the WebP decoder
# keeps two canvases and hands out a third.
BYTES_PER_PIXEL = {"BMP": 8, "PNG": 8, "JPEG": 13, "WebP": 17}

# What decoding may take at a time in one process: one WebP picture of the default limit, or
# several smaller ones. A file of 38 bytes may unpack to all the pixels that the limits admit, so
# the number of requests would otherwise multiply it.
MEMORY_AT_A_TIME = 24_000_000 * 17

# Pixels are converted in strips of rows, so that no second whole picture is held.
_STRIP_PIXELS = 2**18


class Turns:
    """Lets pictures be decoded at the same time while they together fit a budget of memory.

    First come, first served, so that small pictures do not starve a large one. A picture that
    exceeds the budget is decoded alone.

    Parameters
    ----------
    budget
        Bytes.
    """

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._taken = 0
        self._waiting: deque[object] = deque()
        self._changed = threading.Condition()

    @contextmanager
    def turn(self, size: int) -> Iterator[None]:
        """Wait until ``size`` bytes fit, and hold them."""
        ticket = object()
        with self._changed:
            self._waiting.append(ticket)
            try:
                self._changed.wait_for(
                    lambda: (
                        self._waiting[0] is ticket
                        and (self._taken == 0 or self._taken + size <= self._budget)
                    )
                )
                self._taken += size
            finally:
                self._waiting.remove(ticket)
                self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._taken -= size
                self._changed.notify_all()


_turns = Turns(MEMORY_AT_A_TIME)


@dataclass(frozen=True, kw_only=True)
class ImageLimits:
    """What a picture may cost before its pixels are decoded.

    Attributes
    ----------
    max_bytes
        Size of the encoded picture. 10 MiB holds a 24 MP JPEG of a phone.
    max_pixels
        Width times height as the header states them. 24 million holds the photos of common
        phones; what a picture takes in memory is in docs/models.md.
    max_side
        Longer side in pixels.
    max_scans
        Scans of a JPEG of ``max_pixels``; a smaller one may have more in proportion. Each scan of a
        progressive JPEG walks over the whole picture, whatever few bytes it has: 90 over 24 MP
        in a file of 146 kB take nine times the work of decoding an ordinary photo of that size.
    """

    max_bytes: int = 10 * 2**20
    max_pixels: int = 24_000_000
    max_side: int = 16_384
    max_scans: int = 18


DEFAULT_LIMITS = ImageLimits()


def decode_image(data: bytes, *, limits: ImageLimits = DEFAULT_LIMITS) -> NDArray[np.uint8]:
    """Decode a JPEG, PNG, WebP or BMP picture.

    The EXIF orientation is applied. Greyscale, palette, CMYK and 16-bit pictures are converted
    to 8-bit RGB (16 bits are scaled by 255/65535, not clipped); transparency is laid over white.
    Animated pictures are refused: which frame was meant is not known. Pictures that
    together take more than `MEMORY_AT_A_TIME` wait for each other.

    Parameters
    ----------
    data
        The encoded picture. Its name and declared type do not matter.
    limits
        Bytes, pixels, sides and scans, checked before pixels are decoded.

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
        raise ImageError("unsupported_image", "The photo is empty: send the complete file.")
    if len(data) > limits.max_bytes:
        raise ImageError(
            "image_too_large",
            f"The picture has {len(data)} bytes; at most {limits.max_bytes} are accepted."
            f" {SMALLER}",
        )
    try:
        return _decode(data, limits)
    except ImageError:
        raise
    except Image.DecompressionBombError:
        raise ImageError(
            "image_too_large",
            f"The picture states more pixels than the decoder accepts. {SMALLER}",
        ) from None
    except MemoryError:
        raise ImageError(
            "image_too_large", f"The picture does not fit into memory. {SMALLER}"
        ) from None
    # Parsers of damaged files raise almost anything (struct.error, KeyError, TypeError, zlib.error
    # ...), so no narrower clause would hold. The cause is dropped: it may quote the bytes.
    except Exception:
        raise _damaged() from None


def picture_digest(pixels: NDArray[np.uint8]) -> bytes:
    """SHA-256 of a decoded picture: equal for files that show the same pixels upright.

    Parameters
    ----------
    pixels
        As `decode_image` gives them.
    """
    digest = hashlib.sha256(repr(pixels.shape).encode())
    digest.update(pixels.data)
    return digest.digest()


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of an encoded picture states; None where it is none.

    No pixel is decoded, and turns by EXIF are not applied.
    """
    try:
        _check_webp_canvas(data, DEFAULT_LIMITS)
        parsed = lean(data)
        with _metadata_lock, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(parsed), formats=FORMATS) as image:
                return image.size
    except Exception:  # parsers of damaged files raise almost anything
        return None


def _decode(data: bytes, limits: ImageLimits) -> NDArray[np.uint8]:
    _check_webp_canvas(data, limits)
    data = lean(data)
    if not _is_jpeg_without_end(data):
        return _pixels(data, limits)
    data = data.rstrip(b"\xff")  # of an end marker that was cut in two
    pixels = _pixels(data + _JPEG_END, limits)
    if not np.array_equal(pixels, _pixels(data + _OTHER_END, limits)):
        raise _damaged()
    return pixels


def _is_jpeg_without_end(data: bytes) -> bool:
    return data.startswith(b"\xff\xd8\xff") and data.rfind(_JPEG_END) < data.rfind(b"\xff\xda")


def _damaged() -> ImageError:
    return ImageError(
        "unsupported_image", "The picture is damaged or truncated; send the complete file."
    )


def _pixels(data: bytes, limits: ImageLimits) -> NDArray[np.uint8]:
    with _metadata_lock, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            image = Image.open(io.BytesIO(data), formats=FORMATS)
        except UnidentifiedImageError:
            raise ImageError("unsupported_image", unread_file(data)) from None
        name = _check_header(image, data, limits)
    with image, _turns.turn(image.width * image.height * BYTES_PER_PIXEL[name]):
        image.load()
        with _metadata_lock, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            orientation = _orientation(image)  # PNG may carry it behind the pixels
        return _rgb(image, orientation)


def _check_webp_canvas(data: bytes, limits: ImageLimits) -> None:
    """Check the canvas that a WebP file declares; its decoder allocates it when it is opened."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30:
        return
    match data[12:16]:
        case b"VP8X":
            width = int.from_bytes(data[24:27], "little") + 1
            height = int.from_bytes(data[27:30], "little") + 1
        case b"VP8L" if data[20] == 0x2F:
            bits = int.from_bytes(data[21:25], "little")
            width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        case b"VP8 " if data[23:26] == b"\x9d\x01\x2a":
            width = int.from_bytes(data[26:28], "little") & 0x3FFF
            height = int.from_bytes(data[28:30], "little") & 0x3FFF
        case _:
            return
    _check_size(width, height, limits)


def _check_size(width: int, height: int, limits: ImageLimits) -> None:
    if width <= 0 or height <= 0:
        raise ImageError("unsupported_image", f"The picture has no pixels ({width} x {height}).")
    if max(width, height) > limits.max_side or width * height > limits.max_pixels:
        raise ImageError(
            "image_too_large",
            f"The picture has {width} x {height} pixels; at most {limits.max_pixels} pixels and"
            f" {limits.max_side} on a side are accepted. {SMALLER}",
        )


def _check_header(image: Image.Image, data: bytes, limits: ImageLimits) -> str:
    """Check what the header states, and return the name of the format."""
    name = _READ_AS.get(image.format or "")
    if name is None:
        raise ImageError("unsupported_image", unread_file(data))
    _check_size(image.width, image.height, limits)
    if name != "JPEG" and getattr(image, "is_animated", False):
        raise animated(name)
    if name == "BMP" and image.info["compression"] in _BMP_RUNS:
        raise ImageError(
            "unsupported_image",
            "The BMP file is compressed: save it without compression, or as JPEG.",
        )
    if name == "JPEG":
        pixels = image.width * image.height
        most = min(MAX_JPEG_SCANS, limits.max_scans * limits.max_pixels // pixels)
        if jpeg_scans(data, most=most) > most:
            raise ImageError(
                "unsupported_image",
                f"The JPEG file draws its {pixels} pixels in more than {most} scans; save it again "
                "as a baseline JPEG.",
            )
    return name


def _orientation(image: Image.Image) -> int:
    """EXIF orientation 1...8; 1 where it is absent or unreadable, as viewers do."""
    try:
        value = image.getexif().get(0x0112, 1)
    # Broken EXIF does not make the picture unreadable, and its parser raises anything.
    except Exception:
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _rgb(image: Image.Image, orientation: int) -> NDArray[np.uint8]:
    """Upright RGB pixels of a loaded picture, written strip by strip."""
    width, height = image.size
    shape = (width, height, 3) if orientation in _ON_ITS_SIDE else (height, width, 3)
    pixels = np.empty(shape, dtype=np.uint8)
    stored = _upright(pixels, _INVERSE.get(orientation, orientation))  # as the file has them
    rows = max(1, _STRIP_PIXELS // width)
    for top in range(0, height, rows):
        bottom = min(height, top + rows)
        stored[top:bottom] = _strip(image.crop((0, top, width, bottom)))
    return pixels


def _strip(image: Image.Image) -> NDArray[np.uint8]:
    if image.mode.startswith("I"):
        grey = np.asarray(image).astype(np.float32) * np.float32(255 / 65535)
        whole = np.rint(grey).clip(0, 255).astype(np.uint8)
        return np.broadcast_to(whole[:, :, None], (*whole.shape, 3))
    if image.mode in ("LA", "PA", "RGBA", "La", "RGBa") or "transparency" in image.info:
        image = image.convert("RGBA")
        canvas = Image.new("RGBA", image.size, (BACKGROUND,) * 3 + (255,))
        canvas.alpha_composite(image)
        image = canvas
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"), dtype=np.uint8)


_ON_ITS_SIDE = (5, 6, 7, 8)
# Turning left undoes turning right; the other orientations undo themselves.
_INVERSE = {6: 8, 8: 6}


def _upright(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """A view that undoes what EXIF tag 274 says the camera did (CIPA DC-008, 4.6.4)."""
    if orientation in _ON_ITS_SIDE:
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels
