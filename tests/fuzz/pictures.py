"""Hostile PNG, JPEG and WebP files: headers that lie, metadata that expands, parts without end.

A PNG is taken into its chunks. Some are changed, repeated, removed or joined by hostile ones, and
the whole is written again, with checksums that hold. The others are changed byte by byte.
"""

import io
import random
import struct
import zlib
from functools import cached_property
from typing import Any

import numpy as np
from PIL import Image, PngImagePlugin

from models.decoding import MAX_BYTES, MAX_PIXELS, MAX_SIDE
from models.synthetic import draw_face
from tests.fuzz.mutations import CAP, mutated, some

PNG_START = b"\x89PNG\r\n\x1a\n"
SIDES = (0, 1, 2, 7, 8, 9, 16, 17, 255, 256, 1464, 4095, 4096, 6000, 16383, 16384, 16385, 65535,
         65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1)  # fmt: skip

Part = tuple[bytes, bytes]


def encoded(image: Image.Image, kind: str, **options: Any) -> bytes:
    """The picture as a file."""
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def tiff(rng: random.Random) -> bytes:
    """An EXIF body: often an orientation, among entries of any type, count and place."""
    order, mark = rng.choice((("<", b"II"), (">", b"MM")))
    entries = []
    for _ in range(rng.choice((0, 1, 3, 3, 3, 40, 5000))):
        tag = rng.choice((0x0112, 0x011A, 0x8769, 0x8825, 0xA005, 0xB001, rng.randrange(65536)))
        kind, items = rng.randrange(20), rng.choice((0, 1, 1, 1, 4, 100, 0xFFFF, 2**32 - 1))
        value = struct.pack(order + "I", rng.choice((1, 8, 26, rng.randrange(70_000), 2**32 - 1)))
        if tag == 0x0112 and rng.random() < 0.7:
            kind, items, value = 3, 1, struct.pack(order + "HH", rng.randrange(10), 0)
        entries.append(struct.pack(order + "HHI", tag, kind, items) + value)
    magic, first = rng.choice((42, 42, 42, 43)), rng.choice((8, 8, 8, 0, 7, 2**32 - 1))
    stated = rng.choice((len(entries), len(entries), 0xFFFF, 0))
    start = mark + struct.pack(order + "HIH", magic, first, stated)
    following = struct.pack(order + "I", rng.choice((0, 8, 14, 2**32 - 1)))
    return start + b"".join(entries) + following + rng.randbytes(rng.choice((0, 16, 3000)))


def noise(rng: random.Random) -> bytes:
    return rng.randbytes(rng.choice((0, 1, 2, 6, 13, 26, 300, 3000)))


def chunk(name: bytes, content: bytes) -> bytes:
    crc = struct.pack(">I", zlib.crc32(name + content))
    return struct.pack(">I", len(content)) + name + content + crc


def png_chunks(data: bytes) -> list[Part]:
    """Names and contents of the chunks of a sound file."""
    chunks, at = [], len(PNG_START)
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += size + 12
    return chunks


def png(chunks: list[Part]) -> bytes:
    return PNG_START + b"".join(chunk(name, content) for name, content in chunks)


def hostile_chunk(rng: random.Random) -> Part:
    bomb = zlib.compress(bytes(rng.choice((10, 2**20 - 1, 2**20 + 1, 2**23))), 9)
    name = rng.choice((b"PLTE", b"tRNS", b"fcTL", b"fdAT", b"IDAT", b"IEND", b"gAMA", b"pHYs",
                       b"sBIT", b"CgBI", rng.randbytes(4)))  # fmt: skip
    return rng.choice(
        (
            (b"iCCP", b"x\0\0" + bomb),
            (b"zTXt", b"Raw profile type exif\0\0" + bomb),
            (b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + bomb),
            (b"eXIf", rng.choice((b"", b"Exif\0\0")) + tiff(rng)),
            (b"acTL", struct.pack(">II", rng.choice((0, 1, 2, 2**31)), 0)),
            (b"IHDR", struct.pack(">IIBBBBB", rng.choice(SIDES), rng.choice(SIDES), 8, 2, 0, 0, 0)),
            (b"IDAT", zlib.compress(rng.choice((b"", bytes(10), bytes(2**20))))),
            (name, noise(rng)),
        )
    )


def hostile_png(rng: random.Random, parts: list[Part]) -> bytes:
    """Change the chunks of a file one to four times, and write it with sound checksums."""
    for _ in range(some(rng, 4)):
        at = rng.randrange(len(parts) + 1)
        match rng.randrange(8):
            case 0 | 1:
                parts = [lying_chunk(rng, part) for part in parts]
            case 2 | 3 | 4:
                one = hostile_chunk(rng)
                most = max(1, CAP // (len(one[1]) + 12))
                parts[at:at] = [one] * min(most, rng.choice((1, 1, 1, 1, 3, 300, 100_000)))
            case 5 if parts:
                del parts[at % len(parts)]
            case 6 if parts:
                name, content = parts[at % len(parts)]
                parts[at % len(parts)] = (name, mutated(rng, content, [content]))
            case _ if parts:
                parts.insert(at, rng.choice(parts))
    data = png(parts)
    return data if rng.random() < 0.7 else mutated(rng, data, [data])


def lying_chunk(rng: random.Random, part: Part) -> Part:
    """A head that says other sides, depth, colours or filters."""
    if part[0] != b"IHDR" or len(part[1]) != 13:
        return part
    fields = list(struct.unpack(">IIBBBBB", part[1]))
    field = rng.randrange(7)
    fields[field] = rng.choice(SIDES if field < 2 else (0, 1, 2, 3, 4, 5, 6, 7, 8, 16, 255))
    return b"IHDR", struct.pack(">IIBBBBB", *fields)


def segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 255, marker, min(65535, len(content) + 2)) + content


def riff(chunks: list[Part]) -> bytes:
    body = b"WEBP" + b"".join(
        name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)
        for name, content in chunks
    )
    return b"RIFF" + struct.pack("<I", len(body)) + body


class Pictures:
    """Makes cases for the image decoder from drawn faces, which show nobody."""

    @cached_property
    def sound(self) -> dict[str, list[bytes]]:
        """Files of every form that is read, small enough to decode in a millisecond."""
        image = Image.fromarray(draw_face(1, size=48)[:40])
        exif = Image.Exif()
        exif[0x0112], exif[0x010F] = 6, "maker"
        text = PngImagePlugin.PngInfo()
        text.add_text("Comment", "hello", zip=True)
        frames = [Image.new("RGB", (20, 20), (60 * i, 0, 0)) for i in range(2)]
        deep = np.arange(400, dtype=np.uint16).reshape(20, 20) * 160
        files: list[tuple[str, Image.Image, dict[str, Any]]] = [
            ("JPEG", image, {"exif": exif}),
            ("JPEG", image, {"progressive": True}),
            ("JPEG", image.convert("L"), {}),
            ("JPEG", image.convert("CMYK"), {"quality": 95}),
            ("MPO", image, {"save_all": True, "append_images": [frames[1]]}),
            ("JPEG", image, {"icc_profile": bytes(300), "comment": b"hello", "dpi": (72, 72)}),
            ("PNG", image, {"exif": exif, "pnginfo": text}),
            ("PNG", image.convert("P"), {"transparency": 3}),
            ("PNG", image.convert("LA"), {}),
            ("PNG", image.convert("1"), {}),
            ("PNG", Image.fromarray(deep), {}),
            ("PNG", image.convert("RGBA"), {}),
            ("PNG", frames[0], {"save_all": True, "append_images": frames[1:]}),
            ("WEBP", image, {"exif": exif}),
            ("WEBP", image.convert("RGBA"), {"lossless": True}),
            ("WEBP", image.convert("RGBA"), {"quality": 40}),
            ("WEBP", image, {"lossless": True}),
            ("WEBP", frames[0], {"save_all": True, "append_images": frames[1:]}),
        ]
        sound: dict[str, list[bytes]] = {"PNG": [], "JPEG": [], "WEBP": []}
        for kind, one, options in files:
            sound["JPEG" if kind == "MPO" else kind].append(encoded(one, kind, **options))
        return sound

    @cached_property
    def everything(self) -> list[bytes]:
        return [data for files in self.sound.values() for data in files]

    @cached_property
    def largest(self) -> list[bytes]:
        """Small files that unpack to as many pixels as are accepted."""
        size = (6000, MAX_PIXELS // 6000)
        narrow = (MAX_SIDE, MAX_PIXELS // MAX_SIDE)
        return [
            encoded(Image.new("RGBA", size), "PNG", compress_level=9),
            encoded(Image.new("I;16", narrow), "PNG", compress_level=9),
            encoded(Image.new("P", size), "PNG", compress_level=9, transparency=0),
            encoded(Image.new("CMYK", size), "JPEG", progressive=True),
            encoded(Image.new("RGB", narrow), "JPEG", quality=95),
            encoded(Image.new("RGB", size), "WEBP", lossless=True, quality=0, method=0),
            encoded(
                Image.new("RGB", narrow[::-1] if narrow[1] > 16383 else (16383, 1464)),
                "WEBP",
                method=0,
            ),
        ]

    def make(self, rng: random.Random) -> bytes:
        """One case."""
        kind = rng.choice(tuple(self.sound))
        data = rng.choice(self.sound[kind])
        chance = rng.random()
        if chance < 0.01:
            return rng.choice(self.everything)
        if chance < 0.02:
            return rng.choice(
                (b"", b"\xff\xd8\xff", PNG_START, b"RIFF\x40\0\0\0WEBPVP8X")
            ) + rng.randbytes(rng.randrange(400))
        if chance < 0.021:
            return self._large(rng)
        if kind == "PNG" and chance > 0.35:
            return hostile_png(rng, png_chunks(data))
        return mutated(rng, data, self.everything)

    def _large(self, rng: random.Random) -> bytes:
        """As many pixels, or as many bytes, as are accepted."""
        if rng.random() < 0.6:
            data = rng.choice(self.largest)
            return data if rng.random() < 0.5 else mutated(rng, data, self.everything)
        one, chunks = hostile_chunk(rng), png_chunks(self.sound["PNG"][0])
        room = (MAX_BYTES - CAP) // len(chunk(*one))
        return png([chunks[0], *[one] * max(1, room), *chunks[1:]])
