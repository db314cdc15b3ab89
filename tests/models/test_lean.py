"""Which parts of a picture file are kept: those of its pixels and its orientation, no more."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from models.decoding import decode_image
from models.errors import ImageError
from models.lean import MAX_JPEG_SEGMENTS, MAX_PNG_CHUNKS, lean
from tests.models.test_decoding import CAMERA, SAMPLES, chunk, encode, picture, with_chunk


def segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 255, marker, len(content) + 2) + content


def behind_start(data: bytes, extra: bytes) -> bytes:
    return data[:2] + extra + data[2:]


UPSIDE_DOWN = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 0x0112, 3, 1, 3) + bytes(4)
PACKET = b"http://ns.adobe.com/xap/1.0/\0" + b'<rdf:Description tiff:Orientation="3"/>'
UNREAD_SEGMENTS = {
    "comment": segment(0xFE, b"hello"),
    "profile": segment(0xE2, b"ICC_PROFILE\0\1\1" + bytes(99)),
    "index of pictures": segment(0xE2, b"MPF\0II*\0\x08\0\0\0"),
    "resources": segment(0xED, b"Photoshop 3.0\0" + b"8BIM\x03\xed\0\0\0\0\0\x10" + bytes(16)),
    "extended XMP": segment(0xE1, b"http://ns.adobe.com/xmp/extension/\0" + bytes(99)),
    "thumbnail of JFIF": segment(0xE0, b"JFXX\0\x10" + bytes(99)),
    "fill": b"\xff" * 5000,
    "junk": segment(0xFE, b"") + b"\x11" * 5000,
    "escaped": b"\xff\0\xff\0",
}


@pytest.mark.parametrize("extra", UNREAD_SEGMENTS.values(), ids=UNREAD_SEGMENTS)
@pytest.mark.parametrize("options", [{}, {"progressive": True}])
def test_a_jpeg_loses_what_no_pixel_needs(extra, options):
    plain = encode(Image.fromarray(picture()), "JPEG", **options)
    more = behind_start(plain, extra)
    assert lean(more) == lean(plain) == plain
    np.testing.assert_array_equal(decode_image(more), decode_image(plain))


@pytest.mark.parametrize("sample", range(len(SAMPLES)))
def test_sound_pictures_are_decoded_as_without_it(sample, monkeypatch):
    def attempt() -> object:
        try:
            return decode_image(SAMPLES[sample]).tolist()
        except ImageError as error:
            return str(error)

    with_it = attempt()
    monkeypatch.setattr("models.decoding.lean", lambda data: data)
    assert attempt() == with_it


def test_colours_of_a_jpeg_stay_what_its_segments_say():
    colours = Image.fromarray(picture())
    for mode, marker in (("CMYK", 0xEE), ("RGB", 0xE0)):
        data = encode(colours.convert(mode), "JPEG", quality=95)
        assert bytes([0xFF, marker]) in lean(data)
        direct = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        np.testing.assert_array_equal(decode_image(data), direct)


@pytest.mark.parametrize("content", [UPSIDE_DOWN, PACKET], ids=["EXIF", "XMP"])
def test_the_orientation_of_a_jpeg_is_kept_and_the_first_counts(content):
    data = encode(Image.fromarray(picture()), "JPEG", quality=95)
    turned = behind_start(data, segment(0xE1, content))
    np.testing.assert_array_equal(decode_image(turned), CAMERA[3](decode_image(data)))
    later = content.replace(b"\x01\0\0\0\x03", b"\x01\0\0\0\x06").replace(b'"3"', b'"6"')
    assert later != content
    both = behind_start(data, segment(0xE1, content) + segment(0xE1, later))
    assert lean(both) == lean(turned)


def test_a_png_keeps_transparency_and_loses_the_rest():
    image = Image.fromarray(picture()).convert("P")
    plain = encode(image, transparency=3)
    more = plain
    for name in (b"gAMA", b"iCCP", b"tIME", b"tEXt", b"abCd"):
        more = with_chunk(more, chunk(name, b"x\0\0" + bytes(9)), before=b"IDAT")
    assert lean(more) == plain
    assert b"tRNS" in plain


def test_what_lies_behind_the_end_of_a_png_is_not_read():
    plain = encode(Image.fromarray(picture()))
    np.testing.assert_array_equal(decode_image(plain + chunk(b"acTL", bytes(8))), picture())


@pytest.mark.parametrize(
    ("unit", "most"),
    [
        (segment(0xFE, b""), MAX_JPEG_SEGMENTS),
        (segment(0xE1, b"Exif\0\0"), MAX_JPEG_SEGMENTS),
        (segment(0xDB, b""), MAX_JPEG_SEGMENTS),
        (b"\xff\0", MAX_JPEG_SEGMENTS),
    ],
)
def test_a_jpeg_in_too_many_parts_is_refused(unit, most):
    data = encode(Image.fromarray(picture()), "JPEG")
    assert decode_image(behind_start(data, unit * (most // 2))).shape == (40, 60, 3)
    with pytest.raises(ImageError, match="more than 4096 parts before its first scan") as caught:
        decode_image(behind_start(data, unit * most))
    assert caught.value.code == "unsupported_image"


@pytest.mark.parametrize("name", [b"abCd", b"IDAT", b"tEXt"])
def test_a_png_in_too_many_chunks_is_refused(name):
    data = encode(Image.fromarray(picture()))
    few, many = (
        with_chunk(data, chunk(name, b"") * count, before=b"IDAT")
        for count in (MAX_PNG_CHUNKS // 2, MAX_PNG_CHUNKS)
    )
    np.testing.assert_array_equal(decode_image(few), picture())
    with pytest.raises(ImageError, match="more than 65536 chunks") as caught:
        decode_image(many)
    assert caught.value.code == "unsupported_image"


def test_profiles_of_a_png_are_not_unpacked(monkeypatch):
    def refuse(*_: object) -> bytes:
        raise AssertionError("a profile was unpacked")

    packed = chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(10**6)))
    data = with_chunk(encode(Image.fromarray(picture())), packed * 20, before=b"IDAT")
    monkeypatch.setattr("PIL.PngImagePlugin._safe_zlib_decompress", refuse)
    np.testing.assert_array_equal(decode_image(data), picture())


@pytest.mark.parametrize("size", [0, 1, 60_000])
def test_a_segment_with_an_impossible_length_is_refused(size):
    data = encode(Image.fromarray(picture()), "JPEG")
    broken = behind_start(data, b"\xff\xe1" + struct.pack(">H", size))
    with pytest.raises(ImageError, match="damaged or truncated in its head"):
        decode_image(broken)


@pytest.mark.parametrize(
    "data", [b"\xff\xd8\xff", b"\xff\xd8\xff\xff\xff", b"\xff\xd8\xff\xd9", b"\xff\xd8\xff\0\0"]
)
def test_a_jpeg_without_a_scan_is_refused(data):
    with pytest.raises(ImageError) as caught:
        decode_image(data)
    assert caught.value.code == "unsupported_image"


@pytest.mark.parametrize("data", [b"", b"GIF89a", b"RIFF\0\0\0\0WEBP", b"\xff\xd8"])
def test_other_files_stay_as_they_are(data):
    assert lean(data) is data
