"""Signed probes, against an implementation that was written from docs/rest.md alone."""

import base64
import hashlib
import hmac
import json

import numpy as np
import pytest
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from templates.errors import StoreError
from templates.keys.probe_signature import NONCE, sign_probe, signed_probe

TOKEN = f"vf_{'0a' * 6}_{bytes(range(32)).hex()}"


def by_the_document(subject: str, kind: str, body: bytes, nonce: str, time: int, level: str) -> str:
    secret = bytes.fromhex(TOKEN[-64:])
    key = HKDF(SHA256(), 32, salt=None, info=b"veilface/1/probe-key").derive(secret)
    text = "\n".join(
        [
            "veilface-probe-1",
            subject,
            level,
            kind,
            hashlib.sha256(body).hexdigest(),
            nonce,
            str(time),
        ]
    )
    return hmac.new(key, text.encode(), "sha256").hexdigest()


def test_a_template_is_signed_as_documented() -> None:
    made = sign_probe(TOKEN, "alice", b"wire bytes", level="fmr-1e-3")
    assert made.hmac == by_the_document(
        "alice", "template", b"wire bytes", made.nonce, made.timestamp, "fmr-1e-3"
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64, ">f8"])
def test_an_embedding_is_signed_as_the_doubles_that_json_carries(dtype: str) -> None:
    numbers = np.random.default_rng(0).normal(size=64).astype(dtype)
    numbers[3] = -0.0
    made = signed_probe(TOKEN, "bob", numbers)
    received = json.loads(json.dumps(made))["embedding"]
    received[3] = 0  # as JavaScript writes it
    body = np.array(received, dtype="<f8").tobytes()
    assert made["hmac"] == by_the_document(
        "bob", "embedding", body, made["nonce"], made["timestamp"], ""
    )


def test_several_embeddings_are_signed_by_the_digest_of_each() -> None:
    rows = np.random.default_rng(0).normal(size=(3, 64)).astype(np.float32)
    made = signed_probe(TOKEN, "bob", rows)
    received = json.loads(json.dumps(made))["embeddings"]
    digests = [hashlib.sha256(np.array(row, dtype="<f8").tobytes()).digest() for row in received]
    assert made["hmac"] == by_the_document(
        "bob", "embeddings", b"".join(digests), made["nonce"], made["timestamp"], ""
    )


def test_where_an_embedding_ends_is_signed() -> None:
    fixed = {"nonce": "n" * 16, "timestamp": 1000}
    numbers = np.arange(12.0)
    shapes = ((12,), (1, 12), (2, 6), (3, 4), (12, 1))
    made = {sign_probe(TOKEN, "bob", numbers.reshape(shape), **fixed).hmac for shape in shapes}
    assert len(made) == len(shapes)


def test_every_part_changes_the_signature() -> None:
    fixed = {"nonce": "n" * 16, "timestamp": 1000}
    base = sign_probe(TOKEN, "alice", b"probe", level="a", **fixed).hmac
    others = [
        sign_probe(TOKEN, "alicf", b"probe", level="a", **fixed),
        sign_probe(TOKEN, "alice", b"probf", level="a", **fixed),
        sign_probe(TOKEN, "alice", b"probe", level="b", **fixed),
        sign_probe(TOKEN, "alice", b"probe", level=None, **fixed),
        sign_probe(TOKEN, "alice", b"probe", level="a", nonce="m" * 16, timestamp=1000),
        sign_probe(TOKEN, "alice", b"probe", level="a", nonce="n" * 16, timestamp=1001),
        sign_probe(TOKEN[:-1] + "0", "alice", b"probe", level="a", **fixed),
        sign_probe(TOKEN, "alice", np.zeros(1), level="a", **fixed),
    ]
    assert len({base, *(other.hmac for other in others)}) == 1 + len(others)


def test_a_body_carries_the_probe_and_a_nonce_of_its_own() -> None:
    first, second = (signed_probe(TOKEN, "alice", b"probe", level="x") for _ in range(2))
    assert base64.b64decode(first["template"]) == b"probe"
    assert first["level"] == "x"
    assert first["nonce"] != second["nonce"]
    assert NONCE.fullmatch(first["nonce"])


def test_only_a_token_signs() -> None:
    with pytest.raises(StoreError, match="not an API token"):
        sign_probe("password", "alice", b"probe")
