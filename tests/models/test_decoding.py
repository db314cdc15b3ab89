import io
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from models import decoding
from models.decoding import decode_image
from models.errors import ImageError
from tests.models.pictures import encode, in_scans, oriented, picture, png, refusal


@pytest.mark.parametrize(
    ("kind", "options"), [("PNG", {}), ("WEBP", {"lossless": True}), ("BMP", {})]
)
def test_lossless_rgb_is_returned_as_it_was(kind, options):
    pixels = decode_image(encode(Image.fromarray(picture()), kind, **options))
    np.testing.assert_array_equal(pixels, picture())
    assert pixels.flags.c_contiguous
    assert pixels.dtype == np.uint8


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


@pytest.mark.parametrize("orientation", CAMERA)
@pytest.mark.parametrize(("kind", "options"), [("PNG", {}), ("WEBP", {"lossless": True})])
def test_exif_orientation_is_undone(orientation, kind, options):
    # Larger than a strip of rows.
    upright = np.random.default_rng(5).integers(0, 256, (601, 997, 3), dtype=np.uint8)
    stored = Image.fromarray(np.ascontiguousarray(CAMERA[orientation](upright)))
    data = encode(stored, kind, exif=oriented(orientation), **options)
    np.testing.assert_array_equal(decode_image(data), upright)


def test_the_orientation_of_a_jpeg_is_undone():
    plain = encode(Image.fromarray(picture()), "JPEG", quality=95)
    turned = encode(Image.fromarray(picture()), "JPEG", quality=95, exif=oriented(6))
    np.testing.assert_array_equal(decode_image(turned), np.rot90(decode_image(plain), -1))
    assert np.abs(decode_image(plain).astype(int) - picture()).mean() < 3


def test_sixteen_bits_are_scaled_not_clipped():
    values = np.array([[0, 128, 257, 32768, 65535]], dtype=np.uint16)
    pixels = decode_image(encode(Image.fromarray(values)))
    expected = np.rint(values / 65535 * 255).astype(np.uint8)
    np.testing.assert_array_equal(pixels, np.repeat(expected[:, :, None], 3, axis=2))
    rows = np.array([[0, 1000, 40000], [65535, 257, 32768]], dtype=">u2")
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    pixels = decode_image(png(1, 2, depth=16, pixels=raw))
    assert np.abs(pixels[:, 0].astype(float) - rows.astype(float) / 257).max() <= 1


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "L", "1", "RGB"])
def test_any_mode_becomes_rgb_over_white(mode):
    """As Pillow lays the whole picture over white at once; it has several strips here."""
    pixels = np.random.default_rng(3).integers(0, 256, (601, 997, 4), dtype=np.uint8)
    image = Image.fromarray(pixels)
    image = image.convert("RGB").quantize(200) if mode == "P" else image.convert(mode)
    data = encode(image, **({"transparency": 3} if mode == "P" else {}))
    whole = Image.open(io.BytesIO(data)).convert("RGBA")
    over = Image.alpha_composite(Image.new("RGBA", whole.size, (255,) * 4), whole)
    np.testing.assert_array_equal(decode_image(data), np.asarray(over.convert("RGB")))


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


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_animations_are_refused_by_name(kind):
    frames = [Image.new("RGB", (20, 20), (60 * i, 0, 0)) for i in range(3)]
    error = refusal(encode(frames[0], kind, save_all=True, append_images=frames[1:]))
    assert "animated" in str(error)
    assert error.code == "unsupported_image"


def box_of(brand: bytes) -> bytes:
    return b"\0\0\0\x18ftyp" + brand + b"\0\0\0\0mif1miaf"


def compressed_bmp(bits: int) -> bytes:
    """20 kB, whose runs are unpacked byte by byte to 23 megapixels."""
    side = 4800
    header = struct.pack("<LiiHHLLLLLL", 40, side, side, 1, bits, {8: 1, 4: 2}[bits], 0, 0, 0, 0, 0)
    palette = bytes(4 << bits)
    start = struct.pack("<2sLHHL", b"BM", 0, 0, 0, 14 + len(header) + len(palette))
    return start + header + palette + b"\1\1\0\0" * side


NOISE = np.random.default_rng(0).integers(0, 256, (80, 80, 3), dtype=np.uint8)
PHOTO = Image.fromarray(picture())
WRONG_FILES = {
    "is a HEIC or AVIF picture": [
        *(encode(PHOTO, "AVIF"), *map(box_of, (b"mif1avif", b"heic", b"mif1"))),
    ],
    "is not a JPEG, PNG, WebP or BMP picture": [
        *(encode(PHOTO, kind) for kind in ("PPM", "GIF", "TIFF", "PDF")),
        *(b"\0", b"not a picture", png(0, 5), box_of(b"isom")),
    ],
    "is compressed": [compressed_bmp(4), compressed_bmp(8)],
    "is empty": [b""],
    "is damaged or truncated": [
        b"\xff\xd8\xff",
        *(encode(Image.fromarray(NOISE), kind)[:-1000] for kind in ("PNG", "JPEG", "WEBP")),
    ],
}


@pytest.mark.parametrize(
    ("said", "data"), [(said, data) for said, files in WRONG_FILES.items() for data in files]
)
def test_what_is_not_read_is_named(said, data):
    error = refusal(data)
    assert said in str(error)
    assert error.code == "unsupported_image"


def test_limits_on_bytes_pixels_and_sides(monkeypatch):
    data = encode(PHOTO)
    for name, most in (("MAX_BYTES", len(data)), ("MAX_PIXELS", 40 * 60), ("MAX_SIDE", 60)):
        monkeypatch.setattr(decoding, name, most - 1)
        error = refusal(data)
        assert error.code == "image_too_large"
        assert str(error).endswith(" Send a smaller copy.")
        monkeypatch.setattr(decoding, name, most)
    assert "60 x 40 pixels; " in str(error)
    assert decode_image(data).shape == (40, 60, 3)


@pytest.mark.parametrize(("pixels", "scans"), [(64 * 64, 18), (2 * 64 * 64, 36), (10**9, 100)])
def test_a_small_picture_may_have_more_scans_in_proportion(pixels, scans, monkeypatch):
    monkeypatch.setattr(decoding, "MAX_PIXELS", pixels)
    assert decode_image(in_scans(scans)).shape == (64, 64, 3)
    assert refusal(in_scans(scans + 1)).code == "unsupported_image"


def samples() -> list[bytes]:
    text = PngImagePlugin.PngInfo()
    text.add_text("Comment", "hello", zip=True)
    frames = [Image.new("RGB", (20, 20), (60 * i, 0, 0)) for i in range(2)]
    return [
        encode(PHOTO, "JPEG", exif=oriented(6)),
        encode(PHOTO, "JPEG", progressive=True),
        encode(PHOTO.convert("CMYK"), "JPEG"),
        encode(PHOTO, "PNG", exif=oriented(6), pnginfo=text),
        encode(PHOTO.convert("P"), "PNG", transparency=3),
        encode(frames[0], "PNG", save_all=True, append_images=frames[1:]),
        encode(PHOTO, "WEBP", exif=oriented(6)),
        encode(PHOTO.convert("RGBA"), "WEBP", lossless=True),
        encode(PHOTO, "BMP"),
        encode(PHOTO.convert("P"), "BMP"),
    ]


SAMPLES = samples()


def harmless(data: bytes) -> bool:
    """Either pixels or an `ImageError`, and never a warning (the suite turns those to errors)."""
    try:
        pixels = decode_image(data)
    except ImageError as error:
        return error.__cause__ is None
    return pixels.dtype == np.uint8 and pixels.ndim == 3 and pixels.flags.c_contiguous


@settings(max_examples=150)
@given(st.sampled_from(SAMPLES), st.data())
def test_nothing_else_escapes_on_flipped_bytes(sample, data):
    broken = bytearray(sample)
    flips = data.draw(
        st.lists(st.tuples(st.integers(0, len(broken) - 1), st.integers(1, 255)), max_size=8)
    )
    for position, mask in flips:
        broken[position] ^= mask
    assert harmless(bytes(broken))


@settings(max_examples=150)
@given(st.sampled_from(SAMPLES), st.floats(0, 1), st.binary(max_size=64))
def test_nothing_else_escapes_on_cut_and_patched_bytes(sample, share, patch):
    cut = int(len(sample) * share)
    assert harmless(sample[:cut])
    assert harmless(sample[:cut] + patch + sample[cut + len(patch) :])
