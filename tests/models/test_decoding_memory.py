"""What hostile and large pictures may cost."""

import struct
import subprocess
import sys
import threading
import tracemalloc
import zlib
from pathlib import Path

import pytest
from PIL import Image

from models.decoding import BYTES_PER_PIXEL, ImageLimits, Turns, decode_image
from models.errors import ImageError
from tests.models.test_decoding import bomb, chunk, code_of, encode
from tests.patience import PATIENCE_S


def peak_bytes(data: bytes) -> int:
    tracemalloc.start()
    try:
        decode_image(data)
    except ImageError:
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


@pytest.mark.parametrize(("width", "height"), [(50_000, 50_000), (2**31 - 1, 1), (1, 2**31 - 1)])
def test_pixel_bombs_are_refused_from_the_header(width, height):
    assert code_of(bomb(width, height)) == "image_too_large"
    assert peak_bytes(bomb(width, height)) < 2**20


def test_webp_canvas_bomb_is_refused_before_its_decoder_starts():
    canvas = (16_383 - 1).to_bytes(3, "little") * 2
    vp8x = b"VP8X" + struct.pack("<I", 10) + b"\0\0\0\0" + canvas
    data = b"RIFF" + struct.pack("<I", 4 + len(vp8x)) + b"WEBP" + vp8x
    assert code_of(data) == "image_too_large"


@pytest.mark.parametrize("name", [b"VP8 ", b"VP8L"])
def test_canvases_of_the_simple_webp_forms_are_refused_before_their_decoder_starts(
    name, monkeypatch
):
    """Pillow's own limit admits 178 million pixels, for which two canvases are asked."""
    side = 12_000
    bits = struct.pack("<I", (side - 1) | (side - 1) << 14)
    body = {
        b"VP8 ": bytes(3) + b"\x9d\x01\x2a" + struct.pack("<HH", side, side),
        b"VP8L": b"\x2f" + bits + bytes(9),
    }[name]
    data = b"RIFF" + struct.pack("<I", 12 + len(body)) + b"WEBP" + name
    data += struct.pack("<I", len(body)) + body + bytes(20)
    monkeypatch.setattr("PIL.WebPImagePlugin._webp", None)
    with pytest.raises(ImageError, match="12000 x 12000 pixels"):
        decode_image(data)


@pytest.mark.parametrize("kind", [b"iCCP", b"zTXt", b"iTXt"])
def test_compressed_metadata_bombs_stay_small(kind):
    packed = zlib.compress(b"\0" * (40 * 2**20), 9)
    head = {b"iCCP": b"x\0\0", b"zTXt": b"x\0\0", b"iTXt": b"x\0\1\0\0\0"}[kind]
    data = bomb(8, 8, chunk(kind, head + packed))
    assert peak_bytes(data) < 16 * 2**20


@pytest.mark.parametrize("keyword", [b"k%d", b"XML:com.adobe.xmp"])
@pytest.mark.parametrize("text", ["a" * (2**20 - 1), "\N{GRINNING FACE}" + "a" * (2**20 - 9)])
def test_many_text_chunks_stay_small(keyword, text):
    """A character takes 4 bytes where the text holds one beyond the basic plane."""
    packed = zlib.compress(text.encode(), 9)
    heads = (keyword.replace(b"%d", b"%d" % i) + b"\0\1\0\0\0" for i in range(60))
    extra = [chunk(b"iTXt", head + packed) for head in heads]
    assert peak_bytes(bomb(8, 8, *extra)) < 16 * 2**20


# Decodes one file in a fresh process and prints by how many bytes its memory peaked.
PEAK = """
import sys
from pathlib import Path
from models.decoding import decode_image

def kib(name):
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith(name))
    return int(line.split()[1])

data = Path(sys.argv[1]).read_bytes()
decode_image(Path(sys.argv[2]).read_bytes())
Path("/proc/self/clear_refs").write_text("5")
before = kib("VmRSS")
decode_image(data)
print((kib("VmHWM") - before) * 1024)
"""
LARGEST = {
    "RGBA": ("PNG", "PNG", {"compress_level": 1}),
    "P": ("PNG", "PNG", {"compress_level": 1, "transparency": 3}),
    "I;16": ("PNG", "PNG", {"compress_level": 1}),
    "CMYK": ("JPEG", "JPEG", {"progressive": True}),
    "RGB": ("WEBP", "WebP", {"lossless": True, "quality": 0, "method": 0}),
    "1": ("BMP", "BMP", {}),
}


@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(),
    reason="the peak of a process's memory is read from /proc, which is absent",
)
@pytest.mark.parametrize("mode", LARGEST)
@pytest.mark.parametrize("share", [4, pytest.param(1, marks=pytest.mark.long)])
def test_the_largest_picture_that_is_accepted_takes_the_stated_memory(mode, share, tmp_path):
    """And one of a quarter of its pixels, in less time."""
    kind, name, options = LARGEST[mode]
    pixels = ImageLimits().max_pixels // share
    size = (3000, pixels // 3000)
    assert size[0] * size[1] == pixels
    large, small = tmp_path / "large", tmp_path / "small"
    large.write_bytes(encode(Image.new(mode, size), kind, **options))
    small.write_bytes(encode(Image.new(mode, (9, 9)), kind, **options))
    command = [sys.executable, "-c", PEAK, str(large), str(small)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    # The result alone takes 3 bytes a pixel: less would mean that nothing was measured.
    assert 3 * pixels < int(done.stdout) <= BYTES_PER_PIXEL[name] * pixels


def test_pictures_wait_while_the_budget_is_taken():
    turns = Turns(10)
    entered = {size: threading.Event() for size in (4, 5, 20)}
    leave = {size: threading.Event() for size in (4, 5, 20)}

    def hold(size):
        with turns.turn(size):
            entered[size].set()
            assert leave[size].wait(PATIENCE_S)

    threads = {size: threading.Thread(target=hold, args=(size,)) for size in (4, 5, 20)}
    threads[4].start()
    assert entered[4].wait(PATIENCE_S)
    threads[5].start()
    assert entered[5].wait(PATIENCE_S)  # 9 of 10 are taken
    threads[20].start()
    assert not entered[20].wait(0.1)
    leave[4].set()
    assert not entered[20].wait(0.1)  # larger than the budget: it waits to be alone
    leave[5].set()
    assert entered[20].wait(PATIENCE_S)
    leave[20].set()
    for thread in threads.values():
        thread.join(PATIENCE_S)
    with pytest.raises(ZeroDivisionError), turns.turn(10):
        _ = 1 / 0
    with turns.turn(10):  # what failed gave its share back
        pass
