import base64
import io
import struct
import warnings
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from models.decoding import ImageLimits, decode_image
from models.errors import ImageError


def encode(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def picture(height: int = 40, width: int = 60) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 4, y * 5, (x + y) * 2], axis=-1).astype(np.uint8)


def chunk(kind: bytes, content: bytes) -> bytes:
    return (
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
    )


def code_of(data: bytes, **limits) -> str:
    with pytest.raises(ImageError) as caught:
        decode_image(data, limits=ImageLimits(**limits))
    assert str(caught.value).endswith(".")
    return caught.value.code


@pytest.mark.parametrize("kind", ["PNG", "WEBP", "BMP"])
def test_lossless_rgb_is_returned_as_it_was(kind):
    data = encode(
        Image.fromarray(picture()), kind, **({"lossless": True} if kind == "WEBP" else {})
    )
    pixels = decode_image(data)
    np.testing.assert_array_equal(pixels, picture())
    assert pixels.flags.c_contiguous
    assert pixels.dtype == np.uint8


def test_jpeg_is_close():
    pixels = decode_image(encode(Image.fromarray(picture()), "JPEG", quality=95))
    assert np.abs(pixels.astype(int) - picture()).mean() < 3


# CIPA DC-008: which side of the picture the first row and the first column are.
CAMERA = {
    1: lambda a: a,
    2: np.fliplr,
    3: lambda a: np.rot90(a, 2),
    4: np.flipud,
    5: lambda a: np.transpose(a, (1, 0, 2)),
    6: lambda a: np.rot90(a, 1),
    7: lambda a: np.transpose(np.rot90(a, 2), (1, 0, 2)),
    8: lambda a: np.rot90(a, -1),
}


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_exif_orientation_is_undone(orientation, kind):
    stored = np.ascontiguousarray(CAMERA[orientation](picture()))
    exif = Image.Exif()
    exif[0x0112] = orientation
    options = {"lossless": True} if kind == "WEBP" else {}
    data = encode(Image.fromarray(stored), kind, exif=exif, **options)
    np.testing.assert_array_equal(decode_image(data), picture())


def test_exif_behind_the_pixels_of_a_png_counts():
    exif = Image.Exif()
    exif[0x0112] = 3
    plain = encode(Image.fromarray(np.ascontiguousarray(np.rot90(picture(), 2))))
    end = plain.rindex(b"IEND") - 4
    data = plain[:end] + chunk(b"eXIf", exif.tobytes()[6:]) + plain[end:]
    np.testing.assert_array_equal(decode_image(data), picture())


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_an_orientation_that_does_not_exist_is_ignored(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    np.testing.assert_array_equal(
        decode_image(encode(Image.fromarray(picture()), exif=exif)), picture()
    )


def test_broken_exif_neither_warns_nor_refuses():
    exif = b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + b"\x01\x12\0\x03\xff\xff\xff\xff" * 40
    data = encode(Image.fromarray(picture()), "JPEG", exif=exif)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        assert decode_image(data).shape == (40, 60, 3)
    assert seen == []


def test_sixteen_bit_grey_is_scaled_not_clipped():
    values = np.array([[0, 128, 257, 32768, 65535]], dtype=np.uint16)
    pixels = decode_image(encode(Image.fromarray(values)))
    expected = np.rint(values / 65535 * 255).astype(np.uint8)
    np.testing.assert_array_equal(pixels, np.repeat(expected[:, :, None], 3, axis=2))


def test_sixteen_bit_colour_is_scaled_not_clipped():
    rows = np.array([[0, 1000, 40000], [65535, 257, 32768]], dtype=">u2")
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    data = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 2, 16, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(raw))
        + chunk(b"IEND", b"")
    )
    pixels = decode_image(data)
    assert np.abs(pixels[:, 0].astype(float) - rows.astype(float) / 257).max() <= 1


def test_grey_becomes_three_equal_channels():
    pixels = decode_image(encode(Image.fromarray(picture()[..., 0])))
    np.testing.assert_array_equal(pixels, np.repeat(picture()[:, :, :1], 3, axis=2))


def test_one_bit_picture():
    pixels = decode_image(encode(Image.fromarray(picture()[..., 0] > 100)))
    np.testing.assert_array_equal(pixels[..., 1], np.where(picture()[..., 0] > 100, 255, 0))


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_transparency_lies_over_white(mode):
    alpha = np.tile(np.array([0, 128, 255], dtype=np.uint8), (4, 1))
    image = Image.new("RGB", (3, 4), (40, 40, 40)).convert(mode)
    image.putalpha(Image.fromarray(alpha))
    pixels = decode_image(encode(image)).astype(float)
    share = alpha[:, :, None] / 255
    assert np.abs(pixels - (share * 40 + (1 - share) * 255)).max() <= 1


def test_palette_with_transparency():
    image = Image.new("P", (2, 1))
    image.putpalette([10, 20, 30, 200, 100, 50])
    image.putpixel((1, 0), 1)
    data = encode(image, transparency=0)
    np.testing.assert_array_equal(decode_image(data)[0], [[255, 255, 255], [200, 100, 50]])


def test_cmyk_jpeg_is_converted():
    image = Image.new("CMYK", (16, 16), (0, 255, 255, 0))  # no cyan: red
    red, green, blue = decode_image(encode(image, "JPEG", quality=100))[8, 8]
    assert red > 240
    assert max(green, blue) < 20
    # Without the marker it is read as with it, as browsers read it.
    marked = encode(image, "JPEG", quality=100)
    at = marked.index(b"\xff\xee")
    bare = marked[:at] + marked[at + 2 + int.from_bytes(marked[at + 2 : at + 4]) :]
    np.testing.assert_array_equal(decode_image(bare), decode_image(marked))


def test_a_phone_picture_with_several_frames_gives_the_first():
    first = Image.fromarray(picture())
    second = Image.new("RGB", (60, 40))
    data = encode(first, "MPO", save_all=True, append_images=[second], quality=95)
    assert Image.open(io.BytesIO(data)).format == "MPO"
    assert np.abs(decode_image(data).astype(int) - picture()).mean() < 3


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_animations_are_refused_by_name(kind):
    frames = [Image.new("RGB", (20, 20), (60 * i, 0, 0)) for i in range(3)]
    data = encode(frames[0], kind, save_all=True, append_images=frames[1:])
    with pytest.raises(ImageError, match="animated") as caught:
        decode_image(data)
    assert caught.value.code == "unsupported_image"


def with_chunk(data: bytes, extra: bytes, *, before: bytes) -> bytes:
    at = data.index(before) - 4
    return data[:at] + extra + data[at:]


@pytest.mark.parametrize("before", [b"IDAT", b"IEND"])
def test_only_the_name_of_a_chunk_makes_a_png_animated(before):
    still = encode(Image.fromarray(picture()))
    text = chunk(b"tEXt", b"Comment\0acTL" + struct.pack(">I", 8) + b"acTL" + bytes(8))
    np.testing.assert_array_equal(decode_image(with_chunk(still, text, before=before)), picture())
    animated = with_chunk(still, chunk(b"acTL", struct.pack(">II", 2, 0)), before=before)
    with pytest.raises(ImageError, match="PNG file is animated") as caught:
        decode_image(animated)
    assert caught.value.code == "unsupported_image"


def box_of(brand: bytes) -> bytes:
    return b"\0\0\0\x18ftyp" + brand + b"\0\0\0\0mif1miaf"


FILES = {
    "an AVIF picture": [encode(Image.fromarray(picture()), "AVIF"), box_of(b"mif1avif")],
    "a HEIC picture": [box_of(b"heic"), box_of(b"mif1")],
    "a video": [box_of(b"isom"), box_of(b"qt  "), b"\x1aE\xdf\xa3\x9fB\x86"],
    "a GIF picture": [encode(Image.fromarray(picture()), "GIF")],
    "a TIFF or raw picture": [encode(Image.fromarray(picture()), "TIFF"), b"MM\0*\0\0\0\x08"],
    "a JPEG 2000 picture": [
        encode(Image.fromarray(picture()), "JPEG2000", no_jp2=bare) for bare in (False, True)
    ],
    "a JPEG XL picture": [b"\xff\x0a\x7a\x12", b"\0\0\0\x0cJXL \r\n\x87\n"],
    "a PDF document": [encode(Image.fromarray(picture()), "PDF")],
    "a ZIP archive": [b"PK\x03\x04\x14\0"],
    "an SVG drawing": [b'<?xml version="1.0"?>\n<svg width="9"/>', b"<svg/>"],
    "a web page": [b"\n<!DOCTYPE html><title>404</title>", b"<HTML><body>"],
    "a picture in base64": [
        base64.b64encode(encode(Image.fromarray(picture()), kind))
        for kind in ("JPEG", "PNG", "WEBP")
    ],
    "not a JPEG, PNG, WebP or BMP picture": [
        encode(Image.fromarray(picture()), kind) for kind in ("PPM", "ICO", "TGA")
    ],
}


@pytest.mark.parametrize(("kind", "data"), [(kind, data) for kind in FILES for data in FILES[kind]])
def test_a_file_of_another_kind_is_named(kind, data):
    with pytest.raises(ImageError, match=f"The file is {kind},") as caught:
        decode_image(data)
    assert caught.value.code == "unsupported_image"


@pytest.mark.parametrize("bits", [4, 8])
def test_compressed_bmp_files_are_refused_before_they_are_unpacked(bits):
    """Of 20 kB, whose runs are unpacked byte by byte to 23 megapixels."""
    side = 4800
    header = struct.pack("<LiiHHLLLLLL", 40, side, side, 1, bits, {8: 1, 4: 2}[bits], 0, 0, 0, 0, 0)
    palette = bytes(4 << bits)
    start = struct.pack("<2sLHHL", b"BM", 0, 0, 0, 14 + len(header) + len(palette))
    with pytest.raises(ImageError, match="BMP file is compressed"):
        decode_image(start + header + palette + b"\1\1\0\0" * side)


@pytest.mark.parametrize(
    "data", [b"", b"\0", b"not a picture", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]
)
def test_what_is_no_picture_is_refused(data):
    assert code_of(data) == "unsupported_image"


@pytest.mark.parametrize(
    ("kind", "share"), [("PNG", 0.5), ("JPEG", 0.5), ("WEBP", 0.5), ("PNG", 0.9)]
)
def test_truncated_pictures_are_refused(kind, share):
    noise = np.random.default_rng(0).integers(0, 256, (80, 80, 3), dtype=np.uint8)
    data = encode(Image.fromarray(noise), kind)
    assert code_of(data[: int(len(data) * share)]) == "unsupported_image"


JPEGS = {
    "coarse": {"quality": 30},
    "fine": {"quality": 100, "subsampling": 0},
    "progressive": {"progressive": True},
    "restarted": {"restart_marker_blocks": 2},
}


@pytest.mark.parametrize("options", JPEGS.values(), ids=JPEGS)
@pytest.mark.parametrize("cut", [1, 2, 3, 4, 5, 6, 8, 12, 50])
def test_a_jpeg_may_lack_its_end_but_no_pixel(options, cut):
    noise = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    thumbnail = encode(Image.fromarray(noise[:8, :8]), "JPEG")
    for photo in (picture(), noise):
        whole = encode(Image.fromarray(photo), "JPEG", exif=b"Exif\0\0II*\0" + thumbnail, **options)
        outcome = attempt(whole[:-cut])
        if isinstance(outcome, ImageError):
            assert "damaged or truncated" in str(outcome)
            assert cut > 2  # more than the marker of the end
        else:
            # The last bit of a progressive file refines a few pixels by a level or two.
            assert np.abs(outcome.astype(int) - decode_image(whole)).mean() < 0.5
            assert cut < 12


def test_a_picture_without_pixels_is_refused():
    data = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", 0, 5, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )
    assert code_of(data) == "unsupported_image"


def bomb(width: int, height: int, *extra: bytes) -> bytes:
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + b"".join(extra)
        + chunk(b"IDAT", zlib.compress(b"\0" * 1000))
        + chunk(b"IEND", b"")
    )


def test_limits_on_bytes_pixels_and_sides():
    data = encode(Image.fromarray(picture()))
    assert code_of(data, max_bytes=len(data) - 1) == "image_too_large"
    assert code_of(data, max_pixels=40 * 60 - 1) == "image_too_large"
    assert code_of(data, max_side=59) == "image_too_large"
    with pytest.raises(ImageError, match=r"60 x 40 pixels; .* Send a smaller copy\.$"):
        decode_image(data, limits=ImageLimits(max_side=59))
    assert decode_image(
        data, limits=ImageLimits(max_bytes=len(data), max_pixels=2400, max_side=60)
    ).shape == (40, 60, 3)


def strips_and_whole(image: Image.Image) -> tuple[np.ndarray, np.ndarray]:
    """A picture of several strips as it is decoded, and as Pillow lays it over white at once."""
    data = encode(image, **({"transparency": 3} if image.mode == "P" else {}))
    whole = Image.open(io.BytesIO(data)).convert("RGBA")
    over = Image.alpha_composite(Image.new("RGBA", whole.size, (255,) * 4), whole)
    return decode_image(data), np.asarray(over.convert("RGB"))


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "L", "1", "RGB"])
def test_strips_join_without_a_seam(mode):
    pixels = np.random.default_rng(3).integers(0, 256, (601, 997, 4), dtype=np.uint8)
    image = Image.fromarray(pixels)
    image = image.convert("RGB").quantize(200) if mode == "P" else image.convert(mode)
    decoded, expected = strips_and_whole(image)
    np.testing.assert_array_equal(decoded, expected)


@pytest.mark.parametrize("before", [b"IDAT", b"IEND"])
def test_an_orientation_in_a_text_of_a_png_counts(before):
    packet = b'<rdf:Description tiff:Orientation="3"/>'
    still = encode(Image.fromarray(np.ascontiguousarray(np.rot90(picture(), 2))))
    text = chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet)
    np.testing.assert_array_equal(decode_image(with_chunk(still, text, before=before)), picture())


@pytest.mark.parametrize("orientation", [1, 6, 7, 8])
def test_strips_are_turned_to_their_place(orientation):
    upright = np.random.default_rng(5).integers(0, 256, (601, 997, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = Image.fromarray(np.ascontiguousarray(CAMERA[orientation](upright)))
    np.testing.assert_array_equal(decode_image(encode(stored, exif=exif)), upright)


def test_jpeg_with_thousands_of_scans_is_refused():
    data = encode(Image.fromarray(picture(64, 64)), "JPEG", progressive=True)
    start = data.rindex(b"\xff\xda")
    scan = data[start:-2]
    assert decode_image(data).shape == (64, 64, 3)
    assert code_of(data[:-2] + scan * 200 + b"\xff\xd9") == "unsupported_image"


def in_scans(count: int, *, size: tuple[int, int] = (64, 64), between: bytes = b"") -> bytes:
    """A progressive JPEG whose last scan is repeated; ``between`` stands before each repetition."""
    data = encode(Image.new("RGB", size, (120, 90, 60)), "JPEG", progressive=True)
    start = data.rindex(b"\xff\xc4", 0, data.rindex(b"\xff\xda"))
    repeated = between + data[start:-2]
    return data[:-2] + repeated * (count - data.count(b"\xff\xda")) + b"\xff\xd9"


@pytest.fixture
def undecoded(monkeypatch):
    """Decoding would fail with another error."""

    def load(self):
        raise AssertionError("a pixel was decoded")

    monkeypatch.setattr("PIL.JpegImagePlugin.JpegImageFile.load", load)


@pytest.mark.usefixtures("undecoded")
def test_many_scans_of_many_pixels_are_refused_before_a_pixel_is_decoded():
    bomb = in_scans(90, size=(6000, 4000))
    assert len(bomb) < 200_000
    with pytest.raises(ImageError, match="24000000 pixels in more than 18 scans; save it again"):
        decode_image(bomb)


def test_an_ordinary_progressive_photo_of_the_most_pixels_is_decoded():
    data = encode(Image.new("RGB", (6000, 4000)), "JPEG", progressive=True)
    assert data.count(b"\xff\xda") == 10
    assert decode_image(data).shape == (4000, 6000, 3)


@pytest.mark.parametrize(("pixels", "scans"), [(64 * 64, 18), (2 * 64 * 64, 36), (10**9, 100)])
def test_a_small_picture_may_have_more_scans_in_proportion(pixels, scans):
    limits = ImageLimits(max_pixels=pixels)
    assert decode_image(in_scans(scans), limits=limits).shape == (64, 64, 3)
    assert code_of(in_scans(scans + 1), max_pixels=pixels) == "unsupported_image"


@pytest.mark.parametrize(
    "between",
    [
        b"\xff\xfe\x00\x04\xff\xd9",  # a comment that holds the mark of the end
        b"\xff\xff\xff\xfe\x00\x04\xff\xd9",
        b"\x00\xff\x00junk\xff\xd3",
    ],
)
def test_scans_cannot_be_hidden(between):
    image = decode_image(in_scans(14, between=between), limits=ImageLimits(max_pixels=64 * 64))
    np.testing.assert_array_equal(
        image, decode_image(in_scans(14), limits=ImageLimits(max_pixels=64 * 64))
    )
    assert code_of(in_scans(19, between=between), max_pixels=64 * 64) == "unsupported_image"


def test_only_scans_of_the_picture_itself_count():
    thumbnail = in_scans(90)
    exif = b"\xff\xe1" + struct.pack(">H", 8 + len(thumbnail)) + b"Exif\0\0" + thumbnail
    still = encode(Image.fromarray(picture(64, 64)), "JPEG", progressive=True)
    film = b"\xff\xda" * 1000
    photo = still[:2] + exif + still[2:] + in_scans(90) + film
    np.testing.assert_array_equal(
        decode_image(photo, limits=ImageLimits(max_pixels=64 * 64)), decode_image(still)
    )


def test_no_warning_leaves_the_decoder_from_a_large_picture():
    data = bomb(10_000, 9_500)  # above the size from which Pillow itself warns
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        assert code_of(data) == "image_too_large"
    assert seen == []


def samples() -> list[bytes]:
    image = Image.fromarray(picture())
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x010F] = "maker"
    text = PngImagePlugin.PngInfo()
    text.add_text("Comment", "hello", zip=True)
    frames = [Image.new("RGB", (20, 20), (60 * i, 0, 0)) for i in range(2)]
    return [
        encode(image, "JPEG", exif=exif),
        encode(image, "JPEG", progressive=True),
        encode(image.convert("CMYK"), "JPEG"),
        encode(image, "PNG", exif=exif, pnginfo=text),
        encode(image.convert("P"), "PNG", transparency=3),
        encode(frames[0], "PNG", save_all=True, append_images=frames[1:]),
        encode(image, "WEBP", exif=exif),
        encode(image.convert("RGBA"), "WEBP", lossless=True),
        encode(image, "BMP"),
        encode(image.convert("P"), "BMP"),
    ]


SAMPLES = samples()


def harmless(data: bytes) -> None:
    """Either pixels or an `ImageError`, and never a warning (the suite turns those to errors)."""
    outcome = attempt(data)
    if isinstance(outcome, ImageError):
        assert outcome.code in ("unsupported_image", "image_too_large")
        assert outcome.__cause__ is None
    else:
        assert outcome.dtype == np.uint8
        assert outcome.ndim == 3
        assert outcome.shape[2] == 3
        assert outcome.flags.c_contiguous


def attempt(data: bytes) -> np.ndarray | ImageError:
    try:
        return decode_image(data)
    except ImageError as error:
        return error


@settings(max_examples=150)
@given(st.sampled_from(SAMPLES), st.data())
def test_nothing_else_escapes_on_flipped_bytes(sample, data):
    broken = bytearray(sample)
    flips = data.draw(
        st.lists(st.tuples(st.integers(0, len(broken) - 1), st.integers(1, 255)), max_size=8)
    )
    for position, mask in flips:
        broken[position] ^= mask
    harmless(bytes(broken))


@settings(max_examples=150)
@given(st.sampled_from(SAMPLES), st.floats(0, 1), st.binary(max_size=64))
def test_nothing_else_escapes_on_cut_and_patched_bytes(sample, share, patch):
    cut = int(len(sample) * share)
    harmless(sample[:cut])
    harmless(sample[:cut] + patch + sample[cut + len(patch) :])


@settings(max_examples=100)
@given(
    st.binary(max_size=300),
    st.sampled_from([b"", b"\xff\xd8\xff\xe1", b"\x89PNG\r\n\x1a\n", b"RIFF\x40\0\0\0WEBPVP8X"]),
)
def test_nothing_else_escapes_on_noise(noise, head):
    harmless(head + noise)
