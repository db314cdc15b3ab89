"""Hostile PNG, JPEG and WebP files: headers that lie, metadata that expands, parts without end."""

import io
import random
import struct
import zlib
from functools import cached_property
from typing import Any

import numpy as np
from PIL import Image, PngImagePlugin

from models.decoding import DEFAULT_LIMITS
from models.synthetic import draw_face
from tests.fuzz.mutations import CAP, mutated, some

PNG_START = b"\x89PNG\r\n\x1a\n"
SIDES = (0, 1, 2, 7, 8, 9, 16, 17, 255, 256, 1464, 4095, 4096, 6000, 16383, 16384, 16385, 65535,
         65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1)  # fmt: skip
DEPTHS = (0, 1, 2, 3, 4, 8, 16, 32, 255)
COLOURS = (0, 1, 2, 3, 4, 5, 6, 7, 255)

Chunks = list[tuple[bytes, bytes]]


def encoded(image: Image.Image, kind: str, **options: Any) -> bytes:
    """The picture as a file."""
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


# EXIF ---------------------------------------------------------------------------------------


def tiff(rng: random.Random) -> bytes:
    """An EXIF body: often an orientation, among entries of any type, count and place."""
    order = rng.choice("<>")
    mark = {"<": b"II", ">": b"MM"}[order]
    count = rng.choice((0, 1, 2, 5, 40, 400, 5000)) if rng.random() < 0.5 else 3
    entries = []
    for _ in range(count):
        tag = rng.choice(
            (0x0112, 0x011A, 0x0128, 0x8769, 0x8825, 0xA005, 0xB001, rng.randrange(65536))
        )
        kind = rng.randrange(20)
        items = rng.choice((0, 1, 1, 1, 2, 4, 5, 100, 0x7FFF, 0xFFFF, 2**31, 2**32 - 1))
        value = rng.choice((1, 3, 6, 8, 9, 26, rng.randrange(70_000), 2**31, 2**32 - 1))
        if tag == 0x0112 and rng.random() < 0.7:
            kind, items, value = 3, 1, rng.randrange(10)
        place = struct.pack(
            order + ("HH" if kind == 3 else "I"), *((value & 65535, 0) if kind == 3 else (value,))
        )
        entries.append(struct.pack(order + "HHI", tag, kind, items) + place)
    first = rng.choice((8, 8, 8, 8, 0, 4, 7, 2**31, 2**32 - 1))
    stated = rng.choice((count, count, count, 0xFFFF, 0)) & 0xFFFF
    following = struct.pack(order + "I", rng.choice((0, 8, 14, 2**32 - 1)))
    magic = rng.choice((42, 42, 42, 42, 43, 0))
    body = mark + struct.pack(order + "HI", magic, first)
    return (
        body
        + struct.pack(order + "H", stated)
        + b"".join(entries)
        + following
        + rng.randbytes(rng.choice((0, 16, 3000)))
    )


def packet(rng: random.Random) -> bytes:
    """An XMP packet."""
    return rng.choice(
        (
            b'<rdf:Description tiff:Orientation="6"/>',
            b"<tiff:Orientation>9</tiff:Orientation>",
            b'tiff:Orientation="' * 5000,
            b"\xff\xfe" * 40,
            b"",
            b'tiff:Orientation="\xd9\xa3"',
        )
    )


# PNG ----------------------------------------------------------------------------------------


def chunk(name: bytes, content: bytes) -> bytes:
    return (
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
    )


def png_chunks(data: bytes) -> Chunks:
    """Names and contents of the chunks of a sound file."""
    chunks, at = [], len(PNG_START)
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += size + 12
    return chunks


def packed(rng: random.Random, size: int) -> bytes:
    """Compressed bytes that unpack to ``size``."""
    unit = rng.choice((b"\0", b"a", b"\0\xff", b"tiff:Orientation="))
    return zlib.compress(unit * (size // len(unit) + 1), 9)


def hostile_chunk(rng: random.Random) -> tuple[bytes, bytes]:
    size = rng.choice((10, 1000, 2**20 - 1, 2**20 + 1, 2**23))
    keyword = rng.choice(
        (b"Comment", b"XML:com.adobe.xmp", b"Raw profile type exif", b"a" * 79, b"")
    )
    raw = b"\nexif\n  40\n" + tiff(rng).hex().encode()
    return rng.choice(
        (
            lambda: (b"iCCP", b"x\0\0" + packed(rng, size)),
            lambda: (b"zTXt", keyword + b"\0\0" + packed(rng, size)),
            lambda: (b"zTXt", b"Raw profile type exif\0\0" + zlib.compress(raw)),
            lambda: (b"tEXt", b"Raw profile type exif\0" + raw),
            lambda: (b"tEXt", keyword + b"\0" + packet(rng)),
            lambda: (b"iTXt", keyword + b"\0\1\0\0\0" + packed(rng, size)),
            lambda: (b"iTXt", keyword + rng.choice((b"\0\0\0\0\0", b"\0\2\0", b"")) + packet(rng)),
            lambda: (b"eXIf", tiff(rng)),
            lambda: (b"eXIf", b"Exif\0\0" + tiff(rng)),
            lambda: (b"PLTE", rng.randbytes(rng.choice((0, 1, 3, 768, 769, 3000)))),
            lambda: (b"tRNS", rng.randbytes(rng.choice((0, 1, 2, 6, 256, 300)))),
            lambda: (b"acTL", struct.pack(">II", rng.choice((0, 1, 2, 2**31)), 0)),
            lambda: (b"fcTL", rng.randbytes(26)),
            lambda: (b"fdAT", rng.randbytes(30)),
            lambda: (
                b"IHDR",
                struct.pack(">IIBBBBB", *(rng.choice(SIDES) for _ in range(2)), 8, 2, 0, 0, 0),
            ),
            lambda: (b"IDAT", b""),
            lambda: (b"IEND", b""),
            lambda: (rng.randbytes(4), rng.randbytes(rng.choice((0, 5, 500)))),
            lambda: (
                rng.choice(
                    (b"gAMA", b"cHRM", b"sRGB", b"pHYs", b"tIME", b"bKGD", b"sBIT", b"CgBI")
                ),
                rng.randbytes(rng.randrange(40)),
            ),
        )
    )()


def hostile_png(rng: random.Random, chunks: Chunks) -> bytes:
    chunks = list(chunks)
    for _ in range(some(rng, 4)):
        at = rng.randrange(len(chunks) + 1)
        match rng.randrange(8):
            case 0 | 1:
                head = next((i for i, (name, _) in enumerate(chunks) if name == b"IHDR"), None)
                if head is not None and len(chunks[head][1]) == 13:
                    fields = list(struct.unpack(">IIBBBBB", chunks[head][1]))
                    field = rng.randrange(7)
                    choices = (
                        SIDES,
                        SIDES,
                        DEPTHS,
                        COLOURS,
                        (0, 1, 255),
                        (0, 1, 255),
                        (0, 1, 2, 255),
                    )
                    fields[field] = rng.choice(choices[field])
                    chunks[head] = (b"IHDR", struct.pack(">IIBBBBB", *fields))
            case 2 | 3 | 4:
                one = hostile_chunk(rng)
                most = max(1, CAP // (len(one[1]) + 12))
                chunks[at:at] = [one] * min(most, rng.choice((1, 1, 1, 1, 3, 100, 100_000)))
            case 5 if chunks:
                del chunks[at % len(chunks)]
            case 6 if chunks:
                name, content = chunks[at % len(chunks)]
                chunks[at % len(chunks)] = (name, mutated(rng, content, [content]))
            case _:
                pixels = rng.choice((b"", bytes(10), rng.randbytes(4000), bytes(2**20)))
                chunks.insert(at, (b"IDAT", zlib.compress(pixels)))
    data = PNG_START + b"".join(chunk(name, content) for name, content in chunks)
    return data if rng.random() < 0.7 else mutated(rng, data, [data])


# JPEG ---------------------------------------------------------------------------------------


def segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 255, marker, min(65535, len(content) + 2)) + content


def jpeg_segments(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Markers and contents before the first scan of a sound file, and all from the scan on."""
    segments, at = [], 2
    while data[at + 1] != 0xDA:
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        segments.append((data[at + 1], data[at + 4 : at + 2 + size]))
        at += 2 + size
    return segments, data[at:]


def hostile_segment(rng: random.Random) -> bytes:
    exif = b"Exif\0\0" + tiff(rng)[:65_000]
    profile = struct.pack(">BB", rng.randrange(256), rng.randrange(256)) + rng.randbytes(40)
    blocks = (
        b"8BIM\x03\xed\0\0" + struct.pack(">I", rng.choice((0, 3, 16, 2**32 - 1))) + bytes(16)
    ) * some(rng, 900)
    return rng.choice(
        (
            lambda: segment(0xE1, exif),
            lambda: segment(0xE1, exif),
            lambda: segment(0xE1, b"Exif\0\0" + rng.randbytes(rng.choice((0, 1, 10, 100)))),
            lambda: segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + packet(rng)),
            lambda: segment(0xE2, b"MPF\0" + tiff(rng)[:65_000]),
            lambda: segment(0xE2, b"ICC_PROFILE\0" + profile),
            lambda: segment(0xE2, b"ICC_PROFILE\0"),
            lambda: segment(0xED, b"Photoshop 3.0\0" + blocks[:65_000]),
            lambda: segment(0xEE, b"Adobe" + rng.randbytes(rng.choice((0, 2, 7)))),
            lambda: segment(0xE0, b"JFIF\0" + rng.randbytes(rng.choice((0, 3, 9)))),
            lambda: segment(0xFE, rng.randbytes(rng.choice((0, 1, 9000)))),
            lambda: segment(0xDB, rng.randbytes(rng.choice((0, 1, 65, 129, 650)))),
            lambda: segment(0xC4, rng.randbytes(rng.choice((0, 17, 30, 400)))),
            lambda: segment(0xDD, rng.randbytes(2)),
            lambda: segment(0xDA, bytes((1, 1, 0, 0, 63, 0))),
            lambda: segment(rng.randrange(0xC0, 0xFF), rng.randbytes(rng.randrange(30))),
            lambda: b"\xff" + bytes([rng.randrange(256)]),
            lambda: b"\xff" * 7 + b"\0" * 3,
            lambda: b"\xff\0",
            lambda: rng.randbytes(9),
        )
    )()


def frame(rng: random.Random, content: bytes) -> bytes:
    """A frame header that says another size, depth or sampling."""
    broken = bytearray(content)
    for _ in range(some(rng, 3)):
        match rng.randrange(4):
            case 0 | 1 if len(broken) >= 5:
                at = rng.choice((1, 3))
                broken[at : at + 2] = struct.pack(">H", rng.choice(SIDES) & 0xFFFF)
            case 2 if len(broken) > 8:
                part = rng.randrange((len(broken) - 6) // 3)
                broken[6 + 3 * part + 1] = rng.choice((0x11, 0x22, 0x14, 0x41, 0x44, 0x21, 0, 0xFF))
            case _ if broken:
                broken[rng.choice((0, min(5, len(broken) - 1)))] = rng.choice(
                    (0, 1, 2, 3, 4, 8, 12, 255)
                )
    return bytes(broken)


def hostile_jpeg(rng: random.Random, data: bytes) -> bytes:
    segments, rest = jpeg_segments(data)
    parts = [(marker, segment(marker, content)) for marker, content in segments]
    for _ in range(some(rng, 4)):
        at = rng.randrange(len(parts) + 1)
        match rng.randrange(8):
            case 0 | 1:
                for place, (marker, whole) in enumerate(parts):
                    if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
                        marker = rng.choice(
                            (marker, marker, marker, 0xC0, 0xC1, 0xC2, 0xC3, 0xC9, 0xCA)
                        )
                        parts[place] = (marker, segment(marker, frame(rng, whole[4:])))
            case 2 | 3 | 4:
                one = hostile_segment(rng)
                times = min(max(1, CAP // len(one)), rng.choice((1, 1, 1, 1, 2, 300, 10**6)))
                parts.insert(at, (0, one * times))
            case 5 if parts:
                del parts[at % len(parts)]
            case 6:
                last = rest.rfind(b"\xff\xda")
                scan = rest[last:-2]
                rest = rest[:-2] + (scan * rng.choice((1, 20, 90, 110)))[:CAP] + rest[-2:]
            case _ if parts:
                marker, whole = parts[at % len(parts)]
                parts[at % len(parts)] = (marker, mutated(rng, whole, [whole]))
    broken = b"\xff\xd8" + b"".join(whole for _, whole in parts) + rest
    return broken if rng.random() < 0.7 else mutated(rng, broken, [broken])


# WebP ---------------------------------------------------------------------------------------


def webp_chunks(data: bytes) -> Chunks:
    chunks, at = [], 12
    while at + 8 <= len(data):
        size = int.from_bytes(data[at + 4 : at + 8], "little")
        chunks.append((data[at : at + 4], data[at + 8 : at + 8 + size]))
        at += 8 + size + size % 2
    return chunks


def riff(chunks: Chunks) -> bytes:
    body = b"WEBP" + b"".join(
        name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)
        for name, content in chunks
    )
    return b"RIFF" + struct.pack("<I", len(body)) + body


def canvas(rng: random.Random) -> bytes:
    """Flags and sides of the extended form."""
    sides = b"".join(((rng.choice(SIDES) - 1) % 2**24).to_bytes(3, "little") for _ in range(2))
    return bytes([rng.choice((0, 0x10, 0x08, 0x02, 0x3E, rng.randrange(256))), 0, 0, 0]) + sides


def hostile_webp(rng: random.Random, chunks: Chunks) -> bytes:
    chunks = list(chunks)
    for _ in range(some(rng, 4)):
        at = rng.randrange(len(chunks) + 1)
        match rng.randrange(7):
            case 0:
                chunks.insert(0, (b"VP8X", canvas(rng)))
            case 1:
                for place, (name, content) in enumerate(chunks):
                    width, height = (rng.choice(SIDES) & 0x3FFF for _ in range(2))
                    if name == b"VP8 " and len(content) >= 10:
                        content = content[:6] + struct.pack("<HH", width, height) + content[10:]
                    elif name == b"VP8L" and len(content) >= 5:
                        bits = (width | height << 14 | rng.randrange(16) << 28) & 0xFFFFFFFF
                        content = content[:1] + struct.pack("<I", bits) + content[5:]
                    chunks[place] = (name, content)
            case 2 | 3:
                name = rng.choice((b"EXIF", b"XMP ", b"ICCP", b"ALPH", b"ANIM", b"ANMF", b"abcd"))
                body = rng.choice(
                    (tiff, packet, lambda r: r.randbytes(rng.choice((0, 1, 6, 16, 900))))
                )(rng)
                most = max(1, CAP // (len(body) + 8))
                chunks[at:at] = [(name, body)] * min(most, rng.choice((1, 1, 1, 2, 100_000)))
            case 4 if chunks:
                del chunks[at % len(chunks)]
            case 5 if chunks:
                chunks.insert(at, rng.choice(chunks))
            case _ if chunks:
                name, content = chunks[at % len(chunks)]
                chunks[at % len(chunks)] = (name, mutated(rng, content, [content]))
    data = riff(chunks)
    return data if rng.random() < 0.7 else mutated(rng, data, [data])


# All ----------------------------------------------------------------------------------------


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
        size = (6000, DEFAULT_LIMITS.max_pixels // 6000)
        narrow = (DEFAULT_LIMITS.max_side, DEFAULT_LIMITS.max_pixels // DEFAULT_LIMITS.max_side)
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
        if chance < 0.35:
            return mutated(rng, data, self.everything)
        match kind:
            case "PNG":
                return hostile_png(rng, png_chunks(data))
            case "JPEG":
                return hostile_jpeg(rng, data)
            case _:
                return hostile_webp(rng, webp_chunks(data))

    def _large(self, rng: random.Random) -> bytes:
        """As many pixels, or as many bytes, as are accepted."""
        if rng.random() < 0.6:
            data = rng.choice(self.largest)
            return data if rng.random() < 0.5 else mutated(rng, data, self.everything)
        room = DEFAULT_LIMITS.max_bytes - CAP
        if rng.random() < 0.5:
            one = chunk(*hostile_chunk(rng))
            chunks = png_chunks(self.sound["PNG"][0])
            start = PNG_START + chunk(*chunks[0])
            rest = b"".join(chunk(*each) for each in chunks[1:])
            return start + one * max(1, room // len(one)) + rest
        one = hostile_segment(rng)
        sound = rng.choice(self.sound["JPEG"])
        return sound[:2] + one * (room // len(one)) + sound[2:]
