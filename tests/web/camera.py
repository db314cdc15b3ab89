"""Chromium's fake camera, fed from photos: a motion JPEG file, written before it is opened."""

import io
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

SIZE = (640, 480)
FRAMES = 4


class FakeCamera:
    """What the browser's camera will show when it is started next."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.shows()

    @property
    def flags(self) -> list[str]:
        """Arguments for Chromium."""
        return [
            "--use-fake-device-for-media-stream",
            "--use-fake-ui-for-media-stream",
            f"--use-file-for-fake-video-capture={self.file}",
        ]

    def shows(self, *photos: Path, dark: float = 1.0) -> None:
        """Show these photos side by side; none: a picture without a face.

        The browser opens the file anew with every start of the camera.
        """
        frame = _frame([Image.open(photo).convert("RGB") for photo in photos])
        if dark < 1:
            frame = frame.point([int(dark * value) for value in range(256)] * 3)
        self._write(frame)

    def _write(self, frame: Image.Image) -> None:
        out = io.BytesIO()
        frame.save(out, "JPEG", quality=92)
        partial = self.file.with_suffix(".part")
        partial.write_bytes(FRAMES * out.getvalue())
        partial.replace(self.file)


def browsers_test_picture(size: tuple[int, int]) -> Image.Image:
    """Draw the test picture of Chromium's fake camera."""
    picture = Image.new("RGB", size, (0, 136, 0))
    draw = ImageDraw.Draw(picture)
    x, y, radius = size[0] // 2, size[1] // 2, size[1] // 4
    draw.pieslice((x - radius, y - radius, x + radius, y + radius), 0, 237, fill=(75, 255, 24))
    draw.text((x - 40, 20), "00:00:00 44", fill=(75, 255, 24))
    return picture


def _frame(photos: Sequence[Image.Image]) -> Image.Image:
    frame = Image.new("RGB", SIZE, (118, 124, 130))
    if not photos:
        draw = ImageDraw.Draw(frame)
        for step in range(0, SIZE[0], 40):
            draw.rectangle((step, 60, step + 18, 420), fill=(90, 110 + step // 8, 150))
        return frame
    side = min(SIZE[1], SIZE[0] // len(photos))
    left = (SIZE[0] - side * len(photos)) // 2
    for index, photo in enumerate(photos):
        frame.paste(photo.resize((side, side)), (left + index * side, (SIZE[1] - side) // 2))
    return frame
