"""What the head of a picture file says, read before a decoder sees the file.

Pillow reads every part of a head, one after the other: a file of 10 MiB may hold a million empty
parts, ten thousand profiles that unpack to a megabyte each, or EXIF in half a million pieces,
which it joins one by one. So a decoder gets a file without metadata, in a bounded number of parts,
and the orientation, which is the only metadatum that is used, is read here.
"""

import re
import struct
from dataclasses import dataclass, field

from models.errors import ImageError

MAX_PNG_CHUNKS = 2**16
"""In 10 MiB, as many as chunks of 160 bytes; encoders write thousands of bytes in each."""
MAX_JPEG_SEGMENTS = 4096
"""Before the first scan. Encoders write about ten, and a profile of 16 MiB needs 256."""

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")

_JPEG = b"\xff\xd8\xff"
_FILL = re.compile(rb"\xff+")
# Inside the coded pixels, 0xFF before 0x00 or a restart marker is none.
_MARKER_AFTER_PIXELS = re.compile(rb"\xff+([\x01-\xcf\xd8-\xfe])")
_SCAN = 0xDA
_END = 0xD9
_EXIF = 0xE1
# JFIF and Adobe say which colours the channels are.
_COLOURS = {0xE0: b"JFIF", 0xEE: b"Adobe"}
_UNREAD = frozenset((0x00, 0xFE, *range(0xE0, 0xF0)))  # junk, comments, applications' own
_WITHOUT_LENGTH = frozenset((0x00, 0x01, *range(0xD0, 0xDA)))

# Why they are not read: docs/models.md.
_PHONE_PICTURE = re.compile(rb"....ftyp(.{0,64}avi[fs]|hei|hev|mif1|msf1)", re.DOTALL)


@dataclass(frozen=True)
class Head:
    """A picture file without metadata, its orientation by EXIF, and the scans of a JPEG file.

    The orientation of a WebP file is left to `exif_orientation`.
    """

    data: bytes = field(repr=False)
    orientation: int = 1
    scans: int = 0


def read_head(data: bytes) -> Head:
    """Read the head of a file, and take out what pixels and orientation do not need."""
    if data.startswith(_PNG):
        return _png_head(data)
    if data.startswith(_JPEG):
        return _jpeg_head(data)
    return Head(data)


def _png_head(data: bytes) -> Head:
    view, kept, orientation, at = memoryview(data), [memoryview(_PNG)], 1, len(_PNG)
    for _ in range(MAX_PNG_CHUNKS):
        name = data[at + 4 : at + 8]
        end = at + 12 + int.from_bytes(data[at : at + 4])  # length, name and checksum around it
        if name == b"acTL":
            raise animated("PNG")
        if name == b"eXIf":
            orientation = exif_orientation(data[at + 8 : end - 4])
        if name in _PNG_CHUNKS:
            kept.append(view[at:end])
        if name == b"IEND" or end >= len(data):
            return Head(b"".join(kept), orientation)
        at = end
    raise ImageError("unsupported_image", f"The PNG file has more than {MAX_PNG_CHUNKS} chunks.")


def _jpeg_head(data: bytes) -> Head:
    view, kept, orientation, at = memoryview(data), [memoryview(data)[:2]], 1, 2
    for _ in range(MAX_JPEG_SEGMENTS):
        # Junk before a marker, and bytes that fill up to it, are skipped by every decoder.
        fill = _FILL.search(data, at)
        if fill is None or fill.end() == len(data):
            raise ImageError(
                "unsupported_image", "The JPEG file is damaged or truncated in its head."
            )
        start, marker = fill.end() - 1, data[fill.end()]
        if marker == _SCAN:
            return Head(b"".join([*kept, view[start:]]), orientation, _scans(data, start))
        at = start + 2
        if marker not in _WITHOUT_LENGTH:
            at += int.from_bytes(data[at : at + 2])
        content = data[start + 4 : at]
        if marker == _EXIF and content.startswith(b"Exif\0\0"):
            orientation = exif_orientation(content)
        if marker in _COLOURS:
            is_needed = content.startswith(_COLOURS[marker])
        else:
            is_needed = marker not in _UNREAD
        if is_needed:
            kept.append(view[start:at])
    raise ImageError(
        "unsupported_image",
        f"The JPEG file has more than {MAX_JPEG_SEGMENTS} parts before its first scan.",
    )


def _scans(data: bytes, at: int) -> int:
    """Count the scans of a JPEG file's first picture, from the first one on.

    Only markers count, up to the end of that picture, as a decoder reads them: further pictures,
    and the film that a phone appends, may hold the same bytes.
    """
    scans = 0
    while (match := _MARKER_AFTER_PIXELS.search(data, at)) is not None and match[1][0] != _END:
        marker, at = match[1][0], match.end()
        scans += marker == _SCAN
        if marker not in _WITHOUT_LENGTH:
            at += int.from_bytes(data[at : at + 2])
    return scans


def exif_orientation(exif: bytes) -> int:
    """Orientation 1...8 in an EXIF body; 1 where it is absent or unreadable, as viewers do.

    References
    ----------
    CIPA DC-008 (Exif 3.0), 4.6.2 and 4.6.4: TIFF header, entries of the first directory, tag 274.
    """
    exif = exif.removeprefix(b"Exif\0\0")
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(exif[:4])
    if order is None:
        return 1
    try:
        (start,) = struct.unpack_from(f"{order}I", exif, 4)
        (count,) = struct.unpack_from(f"{order}H", exif, start)
        for entry in range(start + 2, start + 2 + 12 * count, 12):
            tag, kind, _, value = struct.unpack_from(f"{order}HHIH", exif, entry)
            if tag == 0x0112:
                return value if kind == 3 and 1 <= value <= 8 else 1
    except struct.error:  # it ends before what it announces
        pass
    return 1


def webp_canvas(data: bytes) -> tuple[int, int] | None:
    """Width and height that a WebP file declares; its decoder allocates them when it is opened."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30:
        return None
    match data[12:16]:
        case b"VP8X":
            sides = int.from_bytes(data[24:27], "little"), int.from_bytes(data[27:30], "little")
            return sides[0] + 1, sides[1] + 1
        case b"VP8L":
            bits = int.from_bytes(data[21:25], "little")
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        case b"VP8 ":
            width, height = struct.unpack_from("<HH", data, 26)
            return width & 0x3FFF, height & 0x3FFF
    return None


def animated(name: str) -> ImageError:
    """Return the refusal of a picture that moves."""
    return ImageError(
        "unsupported_image",
        f"The {name} file is animated; send a still picture, so that the frame is known.",
    )


def unread_file(data: bytes) -> ImageError:
    """Return the refusal of a file, which names what phones send most often."""
    return ImageError(
        "unsupported_image",
        "The file is a HEIC or AVIF picture, which is not read: save it as JPEG, and send that."
        if _PHONE_PICTURE.match(data[:512])
        else "The file is not a JPEG, PNG, WebP or BMP picture, or is damaged.",
    )
