"""What hostile and large pictures may cost."""

import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import pytest
from PIL import Image

from models.decoding import BYTES_PER_PIXEL, MAX_PIXELS, turn
from tests.models.pictures import encode, png, refusal
from tests.patience import PATIENCE_S


@pytest.mark.parametrize(
    ("width", "height"), [(50_000, 50_000), (10_000, 9_500), (2**31 - 1, 1), (1, 2**31 - 1)]
)
def test_pixel_bombs_are_refused_from_the_header(width, height):
    bomb = png(width, height)
    tracemalloc.start()
    try:
        assert refusal(bomb).code == "image_too_large"
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


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
    "RGBA": ("PNG", {"compress_level": 1}),
    "P": ("PNG", {"compress_level": 1, "transparency": 3}),
    "I;16": ("PNG", {"compress_level": 1}),
    "CMYK": ("JPEG", {"progressive": True}),
    "RGB": ("WEBP", {"lossless": True, "quality": 0, "method": 0}),
    "1": ("BMP", {}),
}


@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(),
    reason="the peak of a process's memory is read from /proc, which is absent",
)
@pytest.mark.parametrize("mode", LARGEST)
@pytest.mark.parametrize("share", [4, pytest.param(1, marks=pytest.mark.long)])
def test_the_largest_picture_that_is_accepted_takes_the_stated_memory(mode, share, tmp_path):
    """And one of a quarter of its pixels, in less time."""
    kind, options = LARGEST[mode]
    pixels = MAX_PIXELS // share
    size = (3000, pixels // 3000)
    assert size[0] * size[1] == pixels
    large, small = tmp_path / "large", tmp_path / "small"
    large.write_bytes(encode(Image.new(mode, size), kind, **options))
    small.write_bytes(encode(Image.new(mode, (9, 9)), kind, **options))
    command = [sys.executable, "-c", PEAK, str(large), str(small)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    # The result alone takes 3 bytes a pixel: less would mean that nothing was measured.
    assert 3 * pixels < int(done.stdout) <= BYTES_PER_PIXEL * pixels


def test_pictures_wait_while_others_fill_what_is_decoded_at_a_time():
    entered = threading.Event()

    def enter(pixels):
        with turn(pixels):
            entered.set()

    with pytest.raises(ZeroDivisionError), turn(24_000_000):
        _ = 1 / 0
    with turn(14_000_000), turn(9_000_001):  # what failed gave its share back
        waiting = threading.Thread(target=enter, args=(100_000_000,))
        waiting.start()
        assert not entered.wait(0.1)
    assert entered.wait(PATIENCE_S)
    waiting.join(PATIENCE_S)
