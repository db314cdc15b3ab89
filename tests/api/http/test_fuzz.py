"""Requests that nobody meant: each is answered by the contract, and never with a 500."""

import json
import random
from typing import Any

import pytest

from tests.api.calls import b64, lifted
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.shapes import assert_error

PATHS = [
    ("PUT", "/v1/subjects/{}/enrollment"),
    ("POST", "/v1/subjects/{}/verify"),
    ("GET", "/v1/subjects/{}"),
    ("DELETE", "/v1/subjects/{}"),
    ("GET", "/v1/subjects/{}/export"),
    ("POST", "/v1/subjects/import"),
    ("GET", "/v1/subjects"),
    ("GET", "/v1/contract"),
]
SUBJECTS = ["a", "a" * 128, "a" * 129, "%00", "%ff", "..", "a%2Fb", "ü", "%F0%9F%98%80", "-", "a b"]
CHARSETS = ["utf-8", "utf-7", "utf-16", "idna", "punycode", "zlib", "rot13", "undefined", "no-such",
            "raw_unicode_escape", "mbcs", "base64", "\\x00"]  # fmt: skip
FIELDS = ["level", "face", "attributes", "image", "images", "", "a" * 5000, "\udce4", "näme"]
SCALARS: list[Any] = [None, True, 0, -1, 1e308, 10**300, float("nan"), float("inf"), "", "x",
                      "\ud800", "\x00", "a" * 3000, [], {}, [[]], {"a": {}}]  # fmt: skip


def some_json(rng: random.Random, template: str) -> Any:
    value: Any = rng.choice(SCALARS)
    keys = ["embedding", "embeddings", "template", "level", "export", "attributes", "face"]
    keys += ["\ud800", ""]
    numbers = [rng.choice(SCALARS) for _ in range(64)]
    if rng.random() < 0.8:
        value = {
            rng.choice(keys): rng.choice(
                [*SCALARS, template, template[:-4], numbers, [numbers, [0.125] * 64]]
            )
            for _ in range(rng.randint(0, 3))
        }
    return value


def some_form(rng: random.Random) -> tuple[bytes, str]:
    boundary = rng.choice([b"b", b"x" * 70, b"--", b"'"])
    parts = []
    for _ in range(rng.randint(0, 4)):
        name = rng.choice(FIELDS).encode("utf-8", "surrogateescape")
        filename = rng.choice([b"", b'; filename="f.png"', b"; filename=", b"; filename*=x''%ff"])
        body = rng.choice(
            [photo(1), b"", rng.randbytes(50), b'{"gender": "\\ud800"}', b"largest", b"\xff\xfe"]
        )
        extra = rng.choice(
            [b"", b"Content-Type: image/png\r\n", b"Content-Transfer-Encoding: base64\r\n"]
        )
        parts.append(
            b"--" + boundary + b'\r\nContent-Disposition: form-data; name="' + name + b'"'
            + filename + b"\r\n" + extra + b"\r\n" + body + b"\r\n"
        )  # fmt: skip
    data = b"".join(parts) + b"--" + boundary + b"--\r\n"
    if rng.random() < 0.3:
        data = data[: rng.randint(0, len(data))]
    charset = f"; charset={rng.choice(CHARSETS)}" if rng.random() < 0.5 else ""
    return data, f"multipart/form-data; boundary={boundary.decode()}{charset}"


@pytest.mark.parametrize("seed", range(6))
def test_no_request_is_answered_with_500(client: Client, deployment: Deployment, seed: int) -> None:
    rng = random.Random(seed)
    template = b64(lifted(deployment))
    deployment.allow_templates()
    for _ in range(60):
        method, path = rng.choice(PATHS)
        subject = rng.choice(SUBJECTS) if rng.random() < 0.3 else "a"
        headers: dict[str, Any] = {}
        if rng.random() < 0.5:
            body, headers["Content-Type"] = some_form(rng)
        elif rng.random() < 0.8:
            body = json.dumps(some_json(rng, template)).encode()
            headers["Content-Type"] = rng.choice(["application/json", "", "text/plain"])
        else:
            body = rng.randbytes(rng.randint(0, 200))
            headers["Content-Type"] = rng.choice(["application/json", "multipart/form-data"])
        if rng.random() < 0.1:
            headers["Content-Length"] = rng.choice(
                ["abc", "-1", "9" * 30, "\u00b2".encode("latin-1")]
            )
        if rng.random() < 0.1:
            headers["X-Request-ID"] = rng.choice([b"\xff" * 10, b"a" * 5000])
        params = rng.choice(
            [None, None, "level=%ff", "face=largest", "cursor=%00", "limit=1e3", "&&="]
        )
        answer = client.request(
            method, path.format(subject), content=body, headers=headers, params=params
        )
        assert answer.status_code < 500, (method, path, headers, body[:300], answer.text)
        if answer.status_code >= 400:
            assert_error(answer, answer.status_code, answer.json()["error"]["code"])


def test_text_that_utf8_cannot_carry(client: Client) -> None:
    for labels in ('{"race": "\\ud800"}', '{"gender": "\\u0000"}', '{"gender": "a\\nb"}'):
        answer = client.put(
            "/v1/subjects/surrogate/enrollment",
            files=images(photo(1)),
            data={"attributes": labels},
        )
        assert_error(answer, 422, "validation_failed")
    answer = client.post(
        "/v1/subjects/a/verify",
        content=b'{"embedding": [1.0], "level": "\\ud800"}',
        headers={"Content-Type": "application/json"},
    )
    assert_error(answer, 422, "validation_failed")


def test_a_key_that_is_not_ascii(client: Client) -> None:
    for value in (b"Bearer \xff\xfe", "Bearer ключ".encode()):
        answer = client.get("/v1/contract", headers={"Authorization": value})
        assert_error(answer, 401, "unauthorized")
    assert client.get("/v1/contract", headers=bearer("vf_x")).status_code == 401
