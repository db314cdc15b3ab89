"""What requests of the tests hold: templates and probes as clients make them."""

import base64
from typing import Any

import numpy as np

from api.http.schemas import VerifyAnswer
from templates.contract import wire
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from tests.api.client import Client
from tests.api.deployment import PROBE_M, Deployment, M, N, bearer, images, photo, unit
from tests.api.shapes import assert_answer

AFTER = 5
"""Failures after which a subject is locked, by default."""


def b64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def lifted(deployment: Deployment, *, seed: int = 0, m: int = M, contract_id: str = "") -> bytes:
    """A client's template of a random embedding."""
    embedding = unit(np.random.default_rng([5, seed]).normal(size=(1, N)))
    return _lifted(deployment, embedding, m, Keystream.seeded("client", seed), contract_id)


def probe(deployment: Deployment, embedding: list[float], *, m: int = PROBE_M) -> bytes:
    """A lifted probe of an embedding."""
    rows = np.array([embedding], dtype=np.float32)
    return _lifted(deployment, rows, m, Keystream.seeded("probe"), "")


def _lifted(
    deployment: Deployment, rows: np.ndarray, m: int, stream: Keystream, contract_id: str
) -> bytes:
    batch = lift(
        deployment.source.project(rows),
        strategy=Strategy.ADVERSARIAL,
        m=m,
        source=deployment.source,
        stream=stream,
    )
    return wire.encode(batch[0], contract_id=contract_id or deployment.contract.contract_id)


def embedding(client: Client, person: int, shot: int = 5) -> list[float]:
    """The embedding of a photo, by the service's own pack."""
    pack = client.app.state.runtime.pack
    return [float(number) for number in pack.embed_photo(photo(person, shot)).embedding]


def ask(client: Client, token: str, subject: str = "alice", **request: Any) -> Any:
    """Verify a subject with an API key or a token."""
    headers = bearer(token) | request.pop("headers", {})
    return client.post(f"/v1/subjects/{subject}/verify", headers=headers, **request)


def enroll(client: Client, subject: str = "alice", person: int = 1) -> None:
    answer = client.put(
        f"/v1/subjects/{subject}/enrollment", files=images(photo(person), photo(person, 1))
    )
    assert answer.status_code == 201, answer.text


def attempt(client: Client, token: str, person: int, subject: str = "alice") -> Any:
    return client.post(
        f"/v1/subjects/{subject}/verify",
        files=images(photo(person, 9), name="image"),
        headers=bearer(token),
    )


def fail(client: Client, token: str, times: int, subject: str = "alice") -> None:
    for _ in range(times):
        answer = attempt(client, token, 2, subject)
        assert assert_answer(answer, 200, VerifyAnswer)["decision"] == "reject"
