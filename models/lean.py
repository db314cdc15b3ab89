"""A picture file without the parts that nobody reads, before a parser sees it.

Pillow reads every part of a file's head, one at a time and under a lock of ours: a file of 10 MiB
may hold a million empty parts, ten thousand profiles that unpack to a megabyte each, or EXIF in
half a million pieces, which it joins one by one. Only what pixels and their orientation depend on
is kept here, and the number of parts is bounded.
"""

import re

from models.errors import ImageError

MAX_PNG_CHUNKS = 2**16
"""In 10 MiB, as many as chunks of 160 bytes; encoders write thousands of bytes in each."""
MAX_JPEG_SEGMENTS = 4096
"""Before the first scan. Encoders write about ten, and a profile of 16 MiB needs 256."""

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_TEXTS = (b"tEXt", b"zTXt", b"iTXt")
# Texts in which older programs keep the orientation; Pillow reads it from there.
_ORIENTING_TEXTS = (b"Raw profile type exif", b"XML:com.adobe.xmp")

_JPEG = b"\xff\xd8\xff"
_ORIENTING_SEGMENTS = (b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0")
_FILL = re.compile(rb"\xff+")
# Inside the coded pixels, 0xFF before 0x00 or a restart marker is none.
_MARKER_AFTER_PIXELS = re.compile(rb"\xff+([\x01-\xcf\xd8-\xfe])")
_SCAN = 0xDA
_END = 0xD9
_COMMENT = 0xFE
_APPLICATION = range(0xE0, 0xF0)
# JFIF and Adobe say which colours the channels are.
_COLOURS = {0xE0: b"JFIF", 0xEE: b"Adobe"}
_WITHOUT_LENGTH = frozenset((0x00, 0x01, *range(0xD0, 0xDA)))


def lean(data: bytes) -> bytes:
    """Take out what pixels and orientation do not need; other formats stay as they are.

    Raises
    ------
    ImageError
        With code ``unsupported_image``: an animated PNG, or a file in too many parts.
    """
    if data.startswith(_PNG):
        return _lean_png(data)
    if data.startswith(_JPEG):
        return _lean_jpeg(data)
    return data


def jpeg_scans(data: bytes, *, most: int) -> int:
    """Count the scans of a JPEG file's first picture without decoding them.

    Only markers count, up to the end of that picture, as a decoder reads them: thumbnails, further
    pictures, and the film that a phone appends may hold the same bytes.

    Parameters
    ----------
    most
        One more than these is not looked for.
    """
    scans, at = 0, 2
    while scans <= most and (match := _MARKER_AFTER_PIXELS.search(data, at)) is not None:
        marker, at = match[1][0], match.end()
        if marker == _END:
            break
        scans += marker == _SCAN
        if marker not in _WITHOUT_LENGTH:
            at += int.from_bytes(data[at : at + 2])
    return scans


def animated(name: str) -> ImageError:
    """Return the refusal of a picture that moves."""
    return ImageError(
        "unsupported_image",
        f"The {name} file is animated; send a still picture, so that the frame is known.",
    )


def _lean_png(data: bytes) -> bytes:
    """Keep critical chunks, transparency and orientation; only the names of chunks count.

    A text may contain the four letters of a name. Of chunks with the orientation, the first is
    kept: a second one would only replace it.
    """
    view, kept, start, at = memoryview(data), [], 0, len(_PNG)
    wanted = {b"eXIf", *_ORIENTING_TEXTS}
    chunks = 0
    while at + 8 <= len(data):
        chunks += 1
        if chunks > MAX_PNG_CHUNKS:
            raise _too_many("PNG", MAX_PNG_CHUNKS, "chunks")
        name = data[at + 4 : at + 8]
        end = at + 12 + int.from_bytes(data[at : at + 4])  # length, name and checksum around it
        if name == b"acTL":
            raise animated("PNG")
        if name.isalpha() and name[:1].islower() and name != b"tRNS" and end <= len(data):
            keyword = data[at + 8 : at + 88].partition(b"\0")[0] if name in _PNG_TEXTS else name
            if keyword in wanted:
                wanted.remove(keyword)
            else:
                kept.append(view[start:at])
                start = end
        if name == b"IEND":
            break
        at = end
    return b"".join([*kept, view[start:]]) if kept else data


def _lean_jpeg(data: bytes) -> bytes:
    """Keep tables, frame and colours, and the first EXIF and XMP; from the first scan on, all."""
    view, kept, at = memoryview(data), [memoryview(data)[:2]], 2
    wanted = set(_ORIENTING_SEGMENTS)
    for _ in range(MAX_JPEG_SEGMENTS):
        # Junk before a marker, and bytes that fill up to it, are skipped by every decoder.
        fill = _FILL.search(data, at)
        if fill is None or fill.end() == len(data):
            return b"".join(kept)
        start, marker = fill.end() - 1, data[fill.end()]
        if marker == _SCAN:
            return b"".join([*kept, view[start:]])
        at = fill.end() + 1
        if marker not in _WITHOUT_LENGTH:
            size = int.from_bytes(data[at : at + 2])
            if size < 2 or at + size > len(data):
                raise ImageError(
                    "unsupported_image", "The JPEG file is damaged or truncated in its head."
                )
            at += size
        if _is_needed(marker, data[start + 4 : start + 40], wanted):
            kept.append(view[start:at])
    raise _too_many("JPEG", MAX_JPEG_SEGMENTS, "parts before its first scan")


def _is_needed(marker: int, content: bytes, wanted: set[bytes]) -> bool:
    if marker in _COLOURS and content.startswith(_COLOURS[marker]):
        return True
    if marker not in _APPLICATION:
        return marker not in (0x00, _COMMENT)
    for name in tuple(wanted) if marker == 0xE1 else ():
        if content.startswith(name):
            wanted.remove(name)
            return True
    return False


def _too_many(name: str, most: int, parts: str) -> ImageError:
    return ImageError("unsupported_image", f"The {name} file has more than {most} {parts}.")
