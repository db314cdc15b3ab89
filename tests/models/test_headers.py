"""Which parts of a picture file a decoder gets, and what costs nothing because it does not."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from models import decoding
from models.decoding import decode_image
from models.headers import MAX_JPEG_SEGMENTS, MAX_PNG_CHUNKS, exif_orientation, read_head
from tests.models.pictures import (
    behind_start,
    chunk,
    encode,
    in_scans,
    oriented,
    picture,
    refusal,
    segment,
    with_chunk,
)

PHOTO = Image.fromarray(picture())
JPEG = encode(PHOTO, "JPEG", quality=95)
UNREAD_SEGMENTS = {
    "comment": segment(0xFE, b"hello"),
    "profile": segment(0xE2, b"ICC_PROFILE\0\1\1" + bytes(99)),
    "index of pictures": segment(0xE2, b"MPF\0II*\0\x08\0\0\0"),
    "EXIF": segment(0xE1, oriented(1).tobytes()),
    "XMP": segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + bytes(99)),
    "thumbnail of JFIF": segment(0xE0, b"JFXX\0\x10" + bytes(99)),
    "fill": b"\xff" * 5000,
    "junk": segment(0xFE, b"") + b"\x11" * 5000,
    "escaped": b"\xff\0\xff\0",
}


@pytest.mark.parametrize("extra", UNREAD_SEGMENTS.values(), ids=UNREAD_SEGMENTS)
def test_a_jpeg_loses_what_no_pixel_needs(extra):
    assert read_head(behind_start(JPEG, extra)).data == read_head(JPEG).data == JPEG


def test_colours_of_a_jpeg_stay_what_its_segments_say():
    for mode, marker in (("CMYK", 0xEE), ("RGB", 0xE0)):
        data = encode(PHOTO.convert(mode), "JPEG", quality=95)
        assert bytes([0xFF, marker]) in read_head(data).data


@pytest.mark.parametrize("before", [b"IDAT", b"IEND"])
def test_a_png_keeps_orientation_and_transparency_and_loses_the_rest(before):
    plain = encode(PHOTO.convert("P"), transparency=3)
    more = with_chunk(plain, chunk(b"eXIf", oriented(3).tobytes()[6:]), before=before)
    for name in (b"gAMA", b"iCCP", b"tIME", b"tEXt", b"abCd"):
        more = with_chunk(more, chunk(name, b"x\0acTL" + bytes(9)), before=before)
    head = read_head(more)
    assert head.data == plain
    assert b"tRNS" in plain
    assert head.orientation == 3
    # What lies behind the end is not read.
    assert read_head(plain + chunk(b"acTL", bytes(8))).data == plain
    animated = with_chunk(plain, chunk(b"acTL", struct.pack(">II", 2, 0)), before=before)
    assert "PNG file is animated" in str(refusal(animated))


def tiff(value: int, *, order: str = "<", kind: int = 3, entries: int = 1) -> bytes:
    start = {"<": b"II*\0", ">": b"MM\0*"}[order]
    return start + struct.pack(f"{order}IHHHIHH", 8, entries, 0x0112, kind, 1, value, 0)


@pytest.mark.parametrize(
    ("exif", "orientation"),
    [
        (tiff(6), 6),
        (b"Exif\0\0" + tiff(8, order=">"), 8),
        (tiff(6, entries=9), 6),
        (tiff(6).replace(b"\x12\x01", b"\x13\x01"), 1),
        (tiff(6, kind=4), 1),
        (tiff(0), 1),
        (tiff(9), 1),
        (tiff(6)[:12], 1),
        (b"", 1),
    ],
)
def test_an_orientation_that_cannot_be_read_is_upright(exif, orientation):
    assert exif_orientation(exif) == orientation


@pytest.mark.parametrize("unit", [segment(0xFE, b""), segment(0xDB, b""), b"\xff\0"])
def test_a_jpeg_in_too_many_parts_is_refused(unit):
    assert decode_image(behind_start(JPEG, unit * 2000)).shape == (40, 60, 3)
    error = refusal(behind_start(JPEG, unit * MAX_JPEG_SEGMENTS))
    assert "more than 4096 parts before its first scan" in str(error)
    assert error.code == "unsupported_image"


@pytest.mark.parametrize("name", [b"abCd", b"IDAT"])
def test_a_png_in_too_many_chunks_is_refused(name):
    data = encode(PHOTO)
    many = with_chunk(data, chunk(name, b"") * MAX_PNG_CHUNKS, before=b"IDAT")
    assert "more than 65536 chunks" in str(refusal(many))
    few = with_chunk(data, chunk(name, b"") * 1000, before=b"IDAT")
    np.testing.assert_array_equal(decode_image(few), picture())


@pytest.mark.parametrize(
    "data",
    [
        *(behind_start(JPEG, b"\xff\xe1" + struct.pack(">H", size)) for size in (60_000,)),
        *(b"\xff\xd8\xff", b"\xff\xd8\xff\xff\xff", b"\xff\xd8\xff\xd9", b"\xff\xd8\xff\0\0"),
    ],
)
def test_a_jpeg_without_a_scan_is_refused(data):
    assert "damaged or truncated in its head" in str(refusal(data))


def test_many_scans_of_many_pixels_are_refused_before_a_pixel_is_decoded(monkeypatch):
    def load(self):
        raise AssertionError("a pixel was decoded")

    monkeypatch.setattr("PIL.JpegImagePlugin.JpegImageFile.load", load)
    bomb = in_scans(90, size=(6000, 4000))
    assert len(bomb) < 200_000
    assert "24000000 pixels in more than 18 scans; save it again" in str(refusal(bomb))


def test_an_ordinary_progressive_photo_of_the_most_pixels_is_decoded():
    data = encode(Image.new("RGB", (6000, 4000)), "JPEG", progressive=True)
    assert read_head(data).scans == 10
    assert decode_image(data).shape == (4000, 6000, 3)


@pytest.mark.parametrize(
    "between",
    [
        b"\xff\xfe\x00\x04\xff\xd9",  # a comment that holds the mark of the end
        b"\xff\xff\xff\xfe\x00\x04\xff\xd9",
        b"\x00\xff\x00junk\xff\xd3",
    ],
)
def test_scans_cannot_be_hidden(between):
    data = in_scans(14, between=between)
    assert read_head(data).scans == 14
    np.testing.assert_array_equal(decode_image(data), decode_image(in_scans(14)))


def test_only_scans_of_the_picture_itself_count(monkeypatch):
    thumbnail = in_scans(90)
    exif = segment(0xE1, b"Exif\0\0" + thumbnail)
    still = encode(Image.fromarray(picture(64, 64)), "JPEG", progressive=True)
    film = b"\xff\xda" * 1000
    photo = behind_start(still, exif) + in_scans(90) + film
    monkeypatch.setattr(decoding, "MAX_PIXELS", 64 * 64)
    np.testing.assert_array_equal(decode_image(photo), decode_image(still))


@pytest.mark.parametrize("name", [b"VP8 ", b"VP8L", b"VP8X"])
def test_the_canvas_of_a_webp_file_is_refused_before_its_decoder_starts(name, monkeypatch):
    """Pillow's own limit admits 89 million pixels, for which two canvases are asked."""
    side = 9_000
    body = {
        b"VP8 ": bytes(3) + b"\x9d\x01\x2a" + struct.pack("<HH", side, side),
        b"VP8L": b"\x2f" + struct.pack("<I", (side - 1) | (side - 1) << 14) + bytes(9),
        b"VP8X": bytes(4) + (side - 1).to_bytes(3, "little") * 2,
    }[name]
    data = b"RIFF" + struct.pack("<I", 12 + len(body)) + b"WEBP" + name
    data += struct.pack("<I", len(body)) + body + bytes(20)
    monkeypatch.setattr("PIL.WebPImagePlugin._webp", None)
    error = refusal(data)
    assert "9000 x 9000 pixels" in str(error)
    assert error.code == "image_too_large"


@pytest.mark.parametrize(
    ("name", "head"), [(b"iCCP", b"x\0\0"), (b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0")]
)
def test_profiles_and_texts_of_a_png_are_not_unpacked(name, head, monkeypatch):
    packed = chunk(name, head + zlib.compress(bytes(10**6)))
    data = with_chunk(encode(PHOTO), packed * 20, before=b"IDAT")
    monkeypatch.setattr("PIL.PngImagePlugin._safe_zlib_decompress", None)
    np.testing.assert_array_equal(decode_image(data), picture())
