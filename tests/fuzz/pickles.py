"""Hostile ``.bin`` files: instructions, names and lengths that plain values do not have."""

import itertools
import pickle
import pickletools
import random
import struct
from collections.abc import Sequence

import numpy as np

from tests.fuzz.mutations import NUMBERS, mutated, some
from tests.verify.evaluation.layouts import bin_content

OPCODES = [opcode.code.encode("latin-1") for opcode in pickletools.opcodes]
FORBIDDEN = (
    b"cos\nsystem\n(S'true'\ntR", b"cposix\nsystem\nX\4\0\0\0true\x85R",
    b"\x8c\x08builtins\x8c\x04exec\x93\x8c\x011\x85R", b"(S'true'\nios\nsystem\n",
    b"c__builtin__\ngetattr\n", b"cnumpy\nload\n(S'x'\ntR", b"(cos\nsystem\nS'true'\no",
    b"cnumpy.core.multiarray\nfromfile\n(S'x'\ntR", b"cpickle\nloads\n(C\x01.tR",
    b"cos\nsystem\n)\x81", b"\x82\x01", b"P1\n", b"K\x01Q", b"\x97\x98", b"c\xff\xfe\nx\n",
    b"ccollections\nOrderedDict\n)R", b"cnumpy\ndtype\n(S'O8'\nI0\nI1\ntR",
    b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR",
)  # fmt: skip
STRINGS = ((b"X", "<I"), (b"B", "<I"), (b"C", "<B"), (b"\x8c", "<B"), (b"\x8e", "<Q"),
           (b"\x96", "<Q"))  # fmt: skip
"""Instructions of strings, and how their lengths are written."""


def piece(rng: random.Random) -> bytes:
    """Some instructions: forbidden, of any kind, said often, or a string whose length may lie."""
    many = rng.choice((3, 100, 20_000))
    name, size = rng.choice(STRINGS)
    body = rng.choice((b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", rng.randbytes(40)))
    stated = len(body) if rng.random() < 0.8 else rng.choice(NUMBERS)
    return rng.choice(
        (
            rng.choice(FORBIDDEN),
            rng.choice(OPCODES) + rng.randbytes(rng.randrange(9)),
            name + struct.pack(size, stated & (256 ** struct.calcsize(size) - 1)) + body,
            b"I%d\n" % rng.choice(NUMBERS),
            rng.choice((b"q\0", b"h\0", b"h\xff", b"\x94", b"p-1\n", b"g9999999999\n", b"I01\n")),
            b"]" * many + b"a" * many,
            b"(" * many + b"t" * many,
            b")" + b"\x85" * many,
            b"]\x94" + b"h\x00\x86\x94" * many,
            b"(" + b"\x88\x89" * many + b"l",
            b"\x95" + struct.pack("<Q", rng.choice(NUMBERS) & (2**64 - 1)),
        )
    )


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
            (bins, np.array(same).astype(">i4")),
            (bins[:2], same[:1]),
            ([], []),
            (bins, same, 1),
        )
        self.sound = [
            pickle.dumps(form, protocol) for form in forms for protocol in (0, 2, 3, 4, 5)
        ]

    def make(self, rng: random.Random) -> bytes:
        """One case."""
        data, chance = rng.choice(self.sound), rng.random()
        if chance < 0.02:
            return data
        if chance < 0.4:
            return mutated(rng, data, self.sound)
        if chance < 0.55:
            start = rng.choice((b"", b"\x80\x02", b"\x80\x04", b"\x80\x05"))
            return start + b"".join(piece(rng) for _ in range(some(rng, 40))) + b"."
        return self._rewritten(rng, data)

    @staticmethod
    def _rewritten(rng: random.Random, data: bytes) -> bytes:
        """The instructions of a sound file, some of them gone, said again or among new ones."""
        starts = [position or 0 for _, _, position in pickletools.genops(data)] + [len(data)]
        steps = [data[start:stop] for start, stop in itertools.pairwise(starts)]
        for _ in range(some(rng, 5)):
            at = rng.randrange(len(steps))
            match rng.randrange(4):
                case 0 if len(steps) > 3:
                    del steps[at : at + some(rng, 3)]
                case 1:
                    steps[at : at + 1] = [steps[at]] * rng.choice((2, 2, 3, 500))
                case _:
                    steps.insert(at, piece(rng))
        return b"".join(steps)
