"""Hostile request bodies. The first line of a case is the content type, the rest the body."""

import json
import random

from tests.fuzz.documents import deep, hostile
from tests.fuzz.mutations import CAP, mutated, some

PHOTO = b"\x89PNG\r\n\x1a\n" + bytes(40)
TYPES = (
    b"application/json",
    b"multipart/form-data; boundary=b",
    b"multipart/form-data",
    b"multipart/form-data; boundary=",
    b'multipart/form-data; boundary="b"; charset=zlib',
    b"multipart/form-data; boundary=" + b"b" * 300,
    b"multipart/form-data; boundary=b; charset=utf-16",
    b"text/plain",
    b"",
    b"\xff",
)
DISPOSITIONS = (
    b'form-data; name="images"; filename="a.png"',
    b'form-data; name="level"',
    b"form-data",
    b"",
    b"form-data; name=\"images\"; filename*=utf-8''%ff",
    b'form-data; name="\xff\xfe"',
    b'attachment; name="level"',
    b'form-data; name="' + b"n" * 5000 + b'"',
    b"form-data; name=level; filename",
    b"form-data; =;=;" * 500,
    b'form-data; name="a\\"b"',
    b"form-data; name*0=a; name*1=b; name*1=c",
    b'form-data; name="' + b"\\" * 4000,
)


class Bodies:
    """Makes cases for the readers of JSON and multipart bodies."""

    def __init__(self) -> None:
        self.document = {
            "embedding": [0.1] * 16,
            "embeddings": [[0.1] * 8, [0.2] * 8],
            "template": "AAAA",
            "level": "fmr-1e-3",
        }

    def make(self, rng: random.Random) -> bytes:
        """One case."""
        if rng.random() < 0.4:
            return b"application/json\n" + self._json(rng)
        kind = TYPES[1] if rng.random() < 0.7 else rng.choice(TYPES)
        return kind + b"\n" + self._form(rng)

    def _json(self, rng: random.Random) -> bytes:
        chance = rng.random()
        if chance < 0.2:
            text = json.dumps(self.document).encode()
            return mutated(rng, text, [text])
        if chance < 0.25:
            return deep(rng).encode()
        if chance < 0.252:
            unit = rng.choice((b"[],", b"{},", b'{"":0},', b"0,", b'"",', b'"\xf0\x9f\x98\x80",'))
            return b"[" + unit * (4 * CAP // len(unit) - 1) + b"0]"
        return hostile(rng, self.document)

    @staticmethod
    def _form(rng: random.Random) -> bytes:
        parts = []
        for _ in range(rng.choice((0, 1, 2, 3, 20, 400))):
            heads = [b"Content-Disposition: " + rng.choice(DISPOSITIONS[: rng.choice((2, 13))])]
            for _ in range(rng.choice((0, 0, 1, 2, 200))):
                heads.append(
                    rng.choice(
                        (
                            b"Content-Type: image/png",
                            b"X: " + b"y" * 9000,
                            b":",
                            b"a b: c",
                            b"X:\xff",
                        )
                    )
                )
            body = rng.choice(
                (PHOTO, b"", b"largest", b"\xff", b"x" * 5000, rng.randbytes(40), b"\r\n--b\r\n")
            )
            parts.append(b"--b\r\n" + b"\r\n".join(heads) + b"\r\n\r\n" + body + b"\r\n")
        if parts and rng.random() < 0.02:
            parts *= max(1, CAP // (len(b"".join(parts)) + 1))
        data = b"".join(parts)[: 2 * CAP] + b"--b--\r\n"
        if rng.random() < 0.4:
            for _ in range(some(rng, 2)):
                data = mutated(rng, data, [data])
        return data
