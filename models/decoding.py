"""Bytes of an untrusted picture → upright RGB pixels, or an `ImageError`.

Pillow decodes; this module decides what it may decode. The format is read from the content, the
limits are checked on the header before a pixel is decoded, and whatever a parser raises on
hostile bytes leaves as an `ImageError`.
"""

import hashlib
import io
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from models.errors import ImageError
from models.headers import animated, exif_orientation, read_head, unread_file, webp_canvas

FORMATS = ("JPEG", "PNG", "WEBP", "BMP")
SMALLER = "Send a smaller copy."

MAX_BYTES = 10 * 2**20
"""Of the file: a JPEG of a phone with 24 megapixels."""
MAX_PIXELS = 24_000_000
"""As the header states them."""
MAX_SIDE = 16_384
MAX_SCANS = 18
"""Of a JPEG of `MAX_PIXELS`; a smaller one may have more in proportion, up to `MOST_SCANS`.

Each scan walks over the whole picture, whatever few bytes it has: 90 over 24 megapixels in a file
of 146 kB take nine times the work of decoding an ordinary photo of that size.
"""
MOST_SCANS = 100
# RLE8 and RLE4: Pillow unpacks them in Python, 24 megapixels of 20 kB in 7 seconds.
_BMP_RUNS = (1, 2)
# Pixels are converted in strips of rows, so that no second whole picture is held.
_STRIP_PIXELS = 2**18

BYTES_PER_PIXEL = 17
"""Most memory that decoding takes for a pixel, its result included: 16.4 of WebP, as measured."""
MEGAPIXELS_AT_A_TIME = 24
"""What one process decodes at a time: a file of 38 bytes may unpack to all the pixels that the
limits admit, and the number of requests would multiply it."""

# Pillow's own guard, as the error that it is from twice as many pixels on.
warnings.simplefilter("error", Image.DecompressionBombWarning)

_free = threading.Semaphore(MEGAPIXELS_AT_A_TIME)
_next = threading.Lock()


@contextmanager
def turn(pixels: int) -> Iterator[None]:
    """Wait until a picture fits into what is decoded at a time; first come, first served."""
    share = min(-(-pixels // 10**6), MEGAPIXELS_AT_A_TIME)
    with _next:
        for _ in range(share):
            _free.acquire()
    try:
        yield
    finally:
        _free.release(share)


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG, PNG, WebP or BMP picture; its name and declared type do not matter.

    The EXIF orientation is applied. Greyscale, palette, CMYK and 16-bit pictures are converted
    to 8-bit RGB (16 bits are scaled by 255/65535, not clipped); transparency is laid over white,
    the background of identity photos. Animated pictures are refused: which frame was meant is not
    known. Pictures of together more than `MEGAPIXELS_AT_A_TIME` wait for each other.

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
    if not data:
        raise ImageError("unsupported_image", "The photo is empty: send the complete file.")
    if len(data) > MAX_BYTES:
        raise ImageError(
            "image_too_large",
            f"The picture has {len(data)} bytes; at most {MAX_BYTES} are accepted. {SMALLER}",
        )
    try:
        image, orientation = _open(data)
        with turn(image.width * image.height):
            with image:
                image.load()
                pixels = _rgb(image)
            return np.ascontiguousarray(_upright(pixels, orientation))
    except ImageError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
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
        raise ImageError(
            "unsupported_image", "The picture is damaged or truncated; send the complete file."
        ) from None


def picture_digest(pixels: NDArray[np.uint8]) -> bytes:
    """SHA-256 of a decoded picture: equal for files that show the same pixels upright."""
    digest = hashlib.sha256(repr(pixels.shape).encode())
    digest.update(pixels.data)
    return digest.digest()


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of an encoded picture states; None where it is none.

    No pixel is decoded, and turns by EXIF are not applied.
    """
    try:
        with _open(data)[0] as image:
            return image.size
    except Exception:  # parsers of damaged files raise almost anything
        return None


def _open(data: bytes) -> tuple[Image.Image, int]:
    """Open a picture whose header is within the limits; with its orientation by EXIF."""
    canvas = webp_canvas(data)
    if canvas is not None:
        _check_size(*canvas)
    head = read_head(data)
    try:
        image = Image.open(io.BytesIO(head.data), formats=FORMATS)
    except UnidentifiedImageError:
        raise unread_file(data) from None
    _check_size(image.width, image.height)
    if getattr(image, "is_animated", False):
        raise animated("WebP")
    if image.format == "BMP" and image.info["compression"] in _BMP_RUNS:
        raise ImageError(
            "unsupported_image",
            "The BMP file is compressed: save it without compression, or as JPEG.",
        )
    pixels = image.width * image.height
    most = min(MOST_SCANS, MAX_SCANS * MAX_PIXELS // pixels)
    if head.scans > most:
        raise ImageError(
            "unsupported_image",
            f"The JPEG file draws its {pixels} pixels in more than {most} scans; save it again "
            "as a baseline JPEG.",
        )
    if image.format == "WEBP":
        return image, exif_orientation(image.info.get("exif", b""))
    return image, head.orientation


def _check_size(width: int, height: int) -> None:
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise ImageError(
            "image_too_large",
            f"The picture has {width} x {height} pixels; at most {MAX_PIXELS} pixels and"
            f" {MAX_SIDE} on a side are accepted. {SMALLER}",
        )


def _rgb(image: Image.Image) -> NDArray[np.uint8]:
    """RGB pixels of a loaded picture, written strip by strip."""
    width, height = image.size
    pixels = np.empty((height, width, 3), dtype=np.uint8)
    rows = max(1, _STRIP_PIXELS // width)
    for top in range(0, height, rows):
        strip = image.crop((0, top, width, min(height, top + rows)))
        if strip.mode.startswith("I"):  # 16 bits
            strip = Image.fromarray(((np.asarray(strip, np.uint32) + 128) // 257).astype(np.uint8))
        if strip.has_transparency_data:
            white = Image.new("RGBA", strip.size, "white")
            white.alpha_composite(strip.convert("RGBA"))
            strip = white
        pixels[top : top + rows] = np.asarray(strip.convert("RGB"))
    return pixels


def _upright(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """A view that undoes what EXIF tag 274 says the camera did (CIPA DC-008, 4.6.4)."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels
