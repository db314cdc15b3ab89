"""Hostile ``.bin`` files: instructions, names and shapes that plain values do not have."""

import itertools
import pickle
import pickletools
import random
import struct
from collections.abc import Callable, Sequence

import numpy as np

from tests.fuzz.mutations import NUMBERS, mutated, some
from tests.verify.evaluation.layouts import bin_content

OPCODES = [opcode.code.encode("latin-1") for opcode in pickletools.opcodes]
FORBIDDEN = (
    b"cos\nsystem\n(S'true'\ntR",
    b"cposix\nsystem\nX\4\0\0\0true\x85R",
    b"cbuiltins\neval\n(S'1'\ntR",
    b"\x8c\x08builtins\x8c\x04exec\x93\x8c\x011\x85R",
    b"(S'true'\nios\nsystem\n",
    b"c__builtin__\ngetattr\n",
    b"cnumpy\nload\n(S'x'\ntR",
    b"cnumpy.core.multiarray\nfromfile\n(S'x'\ntR",
    b"cpickle\nloads\n(C\x01.tR",
    b"(cos\nsystem\nS'true'\no",
    b"cos\nsystem\n)\x81",
    b"\x82\x01",
    b"P1\n",
    b"K\x01Q",
    b"\x97\x98",
    b"csubprocess\nPopen\n(]S'true'\natR",
    b"ccollections\nOrderedDict\n)R",
    b"c__main__\nx\n",
    b"cnumpy\ndtype\n(S'O8'\nI0\nI1\ntR",
    b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR",
    b"c\xff\xfe\nx\n",
)

Operations = list[bytes]


def operations(data: bytes) -> Operations:
    """The instructions of a sound pickle, each with its argument."""
    starts = [position or 0 for _, _, position in pickletools.genops(data)] + [len(data)]
    return [data[start:stop] for start, stop in itertools.pairwise(starts)]


def number(rng: random.Random) -> bytes:
    value = rng.choice((0, 1, 2, 255, 65536, 2**31 - 1, -1, rng.choice(NUMBERS)))
    return rng.choice(
        (
            lambda: b"K" + bytes([value & 255]),
            lambda: b"J" + struct.pack("<I", value & 0xFFFFFFFF),
            lambda: b"I%d\n" % value,
            lambda: b"L%dL\n" % value,
            lambda: b"\x8a\x08" + struct.pack("<Q", value & (2**64 - 1)),
            lambda: b"\x8a\xff" + bytes(255),
            lambda: b"I01\n",
            lambda: b"\x88",
        )
    )()


def text(rng: random.Random) -> bytes:
    """A string, some of which state a length that they do not have."""
    body = rng.choice(
        (
            b"",
            b"\xff\xd8\xff",
            b"\x89PNG\r\n\x1a\n",
            b"a\\x00b",
            b"\xf0\x9f\x98\x80" * 9,
            rng.randbytes(40),
        )
    )
    size = len(body) if rng.random() < 0.8 else rng.choice(NUMBERS)
    return rng.choice(
        (
            lambda: b"X" + struct.pack("<I", size & 0xFFFFFFFF) + body,
            lambda: b"B" + struct.pack("<I", size & 0xFFFFFFFF) + body,
            lambda: b"T" + struct.pack("<I", size & 0xFFFFFFFF) + body,
            lambda: b"C" + bytes([size & 255]) + body,
            lambda: b"U" + bytes([size & 255]) + body,
            lambda: b"\x8c" + bytes([size & 255]) + body,
            lambda: b"\x8e" + struct.pack("<Q", size & (2**64 - 1)) + body,
            lambda: b"\x8d" + struct.pack("<Q", size & (2**64 - 1)) + body,
            lambda: b"\x96" + struct.pack("<Q", size & (2**64 - 1)) + body,
            lambda: b"S'" + body.replace(b"\n", b"") + b"'\n",
            lambda: (
                b"V"
                + body.replace(b"\n", b"")
                + rng.choice((b"", b"\\u", b"\\ud800", b"\\U00110000"))
                + b"\n"
            ),
        )
    )()


def memory(rng: random.Random) -> bytes:
    place = rng.choice((0, 1, 2, 255))
    return rng.choice(
        (
            b"q" + bytes([place]),
            b"h" + bytes([place]),
            b"\x94",
            b"p%d\n" % place,
            b"g%d\n" % place,
            b"r" + struct.pack("<I", rng.choice((place, 2**32 - 1))),
            b"j" + struct.pack("<I", place),
            b"p-1\n",
            b"p99999999999999999999\n",
        )
    )


def array(rng: random.Random) -> bytes:
    """An array as NumPy writes it, with any shape, type and contents."""
    code = rng.choice((b"u1", b"b1", b"i8", b"u2", b"O8", b"i4", b"f8", b"V9"))
    order = rng.choice((b"|", b"<", b">", b"=", b"!"))
    shape = b"(" + b"".join(number(rng) for _ in range(rng.randrange(6))) + b"t"
    if rng.random() < 0.4:
        shape = b"K\x03\x85"
    dtype = b"cnumpy\ndtype\n(S'" + code + b"'\nI0\nI1\ntR"
    dtype += b"(I3\nS'" + order + b"'\nNNNI-1\nI-1\nI0\ntb" if rng.random() < 0.8 else b""
    body = rng.choice((b"S'abc'\n", b"C\x03abc", b"(NNNl", b"]", b"C\0", b"N"))
    name = rng.choice((b"numpy.core.multiarray", b"numpy._core.multiarray"))
    start = b"c" + name + b"\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
    state = b"(I1\n" + shape + dtype + rng.choice((b"I00\n", b"\x89")) + body + b"tb"
    return start + state * rng.choice((0, 1, 1, 1, 2))


def piece(rng: random.Random) -> bytes:
    many = rng.choice((3, 100, 20_000))
    return rng.choice(
        (
            lambda: rng.choice(FORBIDDEN),
            lambda: rng.choice(OPCODES),
            lambda: rng.choice(OPCODES) + rng.randbytes(rng.randrange(9)),
            lambda: number(rng),
            lambda: text(rng),
            lambda: memory(rng),
            lambda: array(rng),
            lambda: b"]" * many + b"a" * many,
            lambda: b"(" * many + b"t" * many,
            lambda: b")" + b"\x85" * many,
            lambda: b"]\x94" + b"h\x00\x86\x94" * many,
            lambda: b"(" + b"h\x00" * many + b"e",
            lambda: b"(" + b"\x88\x89" * many + b"l",
            lambda: b"\x94" * many,
            lambda: b"C\x05abcde\x94" + b"c_codecs\nencode\n(h\x00S'latin1'\ntR" * (many // 20),
            lambda: b"\x95" + struct.pack("<Q", rng.choice(NUMBERS) & (2**64 - 1)),
            lambda: pickle.dumps(pickle.dumps([1])),
        )
    )()


def repeated_photos(rng: random.Random) -> bytes:
    """Two equal photos of many bytes, one of them named very often: comparing them has a price."""
    pairs = rng.choice((10, 1000, 40_000))
    photo = b"\x89PNG\r\n\x1a\n" + bytes(rng.choice((10, 5000, 400_000)))
    one = b"B" + struct.pack("<I", len(photo)) + photo
    bins = b"(" + one + one + b"\x94" + b"h\x00" * (2 * pairs - 2) + b"l"
    return b"\x80\x04(" + bins + b"(" + b"\x88\x89" * (pairs // 2) + b"lt."


class Pickles:
    """Makes cases for the reader of ``.bin`` files."""

    def __init__(self) -> None:
        bins, same = bin_content()
        arrays = [np.frombuffer(photo, np.uint8) for photo in bins]
        objects = np.empty(len(bins), dtype=object)
        objects[:] = bins
        forms: Sequence[object] = (
            (bins, same),
            [bins, same],
            (arrays, same),
            ([one[:, None] for one in arrays], same),
            (objects, np.array(same, dtype=object)),
            ([bytearray(one) for one in bins], np.array(same)),
            (bins, [np.bool_(one) for one in same]),
            (bins, [np.int64(one) for one in same]),
            (bins, np.array(same).astype(">i4")),
            (bins[:2], same[:1]),
            ([], []),
            (bins, same, 1),
        )
        self.sound = [
            pickle.dumps(form, protocol) for form in forms for protocol in (0, 2, 3, 4, 5)
        ]
        self.sound += [pickletools.optimize(data) for data in self.sound[3::5]]

    def make(self, rng: random.Random) -> bytes:
        """One case."""
        data = rng.choice(self.sound)
        chance = rng.random()
        if chance < 0.01:
            return data
        if chance < 0.02:
            return repeated_photos(rng)
        if chance < 0.3:
            return mutated(rng, data, self.sound)
        if chance < 0.45:
            start = rng.choice((b"", b"\x80\x02", b"\x80\x04", b"\x80\x05"))
            made = start + b"".join(piece(rng) for _ in range(some(rng, 40))) + b"."
        elif chance < 0.55:
            bins = b"(" + b"".join(self._photo(rng) for _ in range(2)) + b"l"
            answers = rng.choice((lambda: b"(\x88l", lambda: array(rng), lambda: piece(rng)))()
            made = b"\x80\x02" + bins + answers + b"\x86."
        else:
            made = self._rewritten(rng, data)
        return made if rng.random() < 0.8 else mutated(rng, made, self.sound)

    @staticmethod
    def _photo(rng: random.Random) -> bytes:
        makers: tuple[Callable[[random.Random], bytes], ...] = (
            text,
            array,
            piece,
            lambda _: b"C\x09\x89PNG\r\n\x1a\nx",
        )
        return rng.choice(makers)(rng)

    @staticmethod
    def _rewritten(rng: random.Random, data: bytes) -> bytes:
        """The instructions of a sound file, some of them gone, changed or among new ones."""
        steps = operations(data)
        for _ in range(some(rng, 5)):
            at = rng.randrange(len(steps))
            match rng.randrange(5):
                case 0:
                    del steps[at : at + some(rng, 3)]
                case 1 | 2:
                    steps.insert(at, piece(rng))
                case 3:
                    steps[at : at + 1] = [steps[at]] * rng.choice((2, 2, 3, 500))
                case _:
                    other = rng.randrange(len(steps))
                    steps[at], steps[other] = steps[other], steps[at]
            if not steps:
                return b"."
        return b"".join(steps)
