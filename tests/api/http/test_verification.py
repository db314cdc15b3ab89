import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.http.app import create_app
from api.http.schemas import VerifyAnswer
from templates.contract import wire
from templates.keys.sealing import MasterKeyring
from templates.space.subspace import SubspaceBatch
from templates.store import rewrap_keys
from tests.api.calls import ask, b64, embedding, probe
from tests.api.client import Client
from tests.api.deployment import AXES, PROBE_M, Deployment, N, bearer, deploy, images, photo
from tests.api.shapes import assert_answer, assert_error

PRODUCT_KEYS = {
    "decision",
    "reason",
    "liveness",
    "level",
    "fmr",
    "contract_id",
    "calibration_id",
    "request_id",
}


@pytest.fixture(scope="module")
def token(client: Client, deployment: Deployment) -> str:
    """A key that may verify and nothing else; ``alice`` is person 1."""
    answer = client.put("/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)))
    assert answer.status_code == 201
    return deployment.key("verify")


@pytest.fixture(scope="module")
def sender(deployment: Deployment, token: str) -> str:
    """A key that may also send embeddings."""
    return deployment.key("verify", "embeddings")


def test_the_answer_is_exactly_the_contract(client: Client, token: str) -> None:
    for person, decision, reason in ((1, "accept", "match"), (2, "reject", "no_match")):
        answer = ask(client, token, files=images(photo(person, 7), name="image"))
        body = assert_answer(answer, 200, VerifyAnswer)
        assert set(body) == PRODUCT_KEYS
        assert (body["decision"], body["reason"]) == (decision, reason)
        assert (body["level"], body["fmr"]) == ("fmr-1e-3", 1e-3)


def test_who_is_not_enrolled_looks_like_who_does_not_match(
    client: Client, token: str, deployment: Deployment
) -> None:
    known = ask(client, token, files=images(photo(2), name="image")).json()
    unknown = ask(client, token, "nobody", files=images(photo(2), name="image")).json()
    del known["request_id"], unknown["request_id"]
    assert known == unknown
    for right in ("enroll", "admin"):
        told = ask(
            client,
            deployment.key("verify", right),
            "nobody",
            files=images(photo(2), name="image"),
        )
        assert_error(told, 404, "not_enrolled")


@pytest.mark.parametrize("face", [photo(2), b"no picture"], ids=["rejected", "refused"])
def test_who_is_not_enrolled_costs_the_same_steps(
    client: Client, token: str, monkeypatch: pytest.MonkeyPatch, face: bytes
) -> None:
    from sqlalchemy import event

    runtime = client.app.state.runtime
    seen: dict[str, list[str]] = {}
    engine = runtime.store.database.engine
    sent = images(face, name="image")
    for subject in ("alice", "nobody"):
        ask(client, token, subject, files=sent)  # caches are warm
        steps: list[str] = []

        def record(_c: object, _u: object, statement: str, *rest: object) -> None:
            steps.append(statement.split("WHERE")[0])  # noqa: B023

        import templates.keys.sealing as sealing
        import templates.store.envelope as envelope

        event.listen(engine, "before_cursor_execute", record)
        with monkeypatch.context() as patch:
            # AESGCM is final in some releases: wrap by composition there.
            patch.setattr(envelope, "AESGCM", counting_cipher(steps))
            patch.setattr(sealing, "AESGCM", counting_cipher(steps))
            ask(client, token, subject, files=sent)
        event.remove(engine, "before_cursor_execute", record)
        seen[subject] = steps
    assert seen["alice"] == seen["nobody"]
    assert any(step.startswith("decrypt") for step in seen["alice"])


def counting_cipher(steps: list[str]) -> type:
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    class Counting:
        def __init__(self, key: bytes) -> None:
            self._cipher = AESGCM(key)

        def encrypt(self, nonce: bytes, data: bytes, aad: bytes | None) -> bytes:
            return self._cipher.encrypt(nonce, data, aad)

        def decrypt(self, nonce: bytes, data: bytes, aad: bytes | None) -> bytes:
            steps.append(f"decrypt {len(data)}")
            return self._cipher.decrypt(nonce, data, aad)

    return Counting


def test_distance_only_with_scores_and_enroll(client: Client, deployment: Deployment) -> None:
    for rights, told in (
        (("scores",), set()),
        (("enroll",), set()),
        (("scores", "enroll"), {"distance", "distance_threshold"}),
    ):
        token = deployment.key("verify", *rights)
        body = assert_answer(
            ask(client, token, files=images(photo(2), name="image")), 200, VerifyAnswer
        )
        assert set(body) == PRODUCT_KEYS | told
    assert 0 < body["distance"] <= 2
    assert (body["distance"] <= body["distance_threshold"]) == (body["decision"] == "accept")


def test_embeddings_and_lifted_probes(client: Client, sender: str, deployment: Deployment) -> None:
    for person, decision in ((1, "accept"), (2, "reject")):
        descriptor = embedding(client, person)
        raw = ask(client, sender, json={"embedding": descriptor})
        assert assert_answer(raw, 200, VerifyAnswer)["decision"] == decision
        lifted = ask(client, sender, json={"template": b64(probe(deployment, descriptor))})
        assert assert_answer(lifted, 200, VerifyAnswer)["decision"] == decision
    assert raw.json()["calibration_id"] != lifted.json()["calibration_id"]


def test_hostile_embeddings(client: Client, sender: str) -> None:
    good = embedding(client, 1)
    cases: list[Any] = [
        [],
        [0.0] * N,
        [1.0] * N,
        good[:-1],
        [*good, 0.0],
        [x * 1.01 for x in good],
        [1e308] * N,
        [10**400, *good[1:]],
        ["0.1", *good[1:]],
        [None, *good[1:]],
        [True, *good[1:]],
        [good],
        [[x] for x in good],
        [0.1] * 5000,
        "AAAA",
        {"0": 1.0},
        7,
    ]
    bursts: list[Any] = [
        *([], good, [[]], [good, good[:-1]], [good, None], [good, [True, *good[1:]]], [[good]]),
        *([good] * 6, [good, [0.0] * N], [good, [1.01 * x for x in good]], {"0": good}, "AAAA"),
    ]
    for field, tried in (("embedding", cases), ("embeddings", bursts)):
        for case in tried:
            answer = ask(client, sender, json={field: case})
            assert_error(answer, 400, "invalid_embedding")


def test_hostile_lifted_probes(client: Client, sender: str, deployment: Deployment) -> None:
    contract_id = deployment.contract.contract_id
    descriptor = embedding(client, 1)
    whole = probe(deployment, descriptor)
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(AXES, PROBE_M)))[0].T
    central = SubspaceBatch(np.zeros(AXES), basis)
    for data in (
        b"",
        whole[:10],
        whole[:-1],
        whole + b"x",
        wire.encode(central, contract_id=contract_id),
        whole.replace(b'"F16"', b'"F64"'),
    ):
        assert_error(ask(client, sender, json={"template": b64(data)}), 400, "invalid_template")
    other_m = probe(deployment, descriptor, m=PROBE_M + 1)
    assert_error(ask(client, sender, json={"template": b64(other_m)}), 422, "uncalibrated")
    other = SubspaceBatch(basis[0] * 0.0 + np.eye(AXES)[0] * 0, basis)
    foreign = wire.encode(other, contract_id="0" * 64)
    assert_error(ask(client, sender, json={"template": b64(foreign)}), 409, "contract_mismatch")


def test_levels(client: Client, sender: str, token: str) -> None:
    descriptor = embedding(client, 1)
    picked = ask(client, sender, json={"embedding": descriptor, "level": "fmr-1e-2"}).json()
    assert (picked["level"], picked["fmr"]) == ("fmr-1e-2", 1e-2)
    accuracy = ask(
        client, token, files=images(photo(1), name="image"), data={"level": "accuracy"}
    ).json()
    assert accuracy["level"] == "accuracy"
    assert math.isclose(accuracy["fmr"], 1e-3)  # the rate that calibration saw
    for level in ("fmr-1e-9", "x"):
        assert_error(
            ask(client, sender, json={"embedding": descriptor, "level": level}),
            422,
            "uncalibrated",
        )
    # Before anything is decoded.
    for level in ("fmr-1e-9", "fmr-1e-3 "):
        answer = ask(
            client, token, files=images(b"no picture", name="image"), data={"level": level}
        )
        assert_error(answer, 422, "uncalibrated")
    for level in ("", "x" * 65, 7, []):
        assert_error(
            ask(client, sender, json={"embedding": descriptor, "level": level}),
            422,
            "validation_failed",
        )


def test_fields_are_checked(client: Client, sender: str) -> None:
    descriptor = embedding(client, 1)
    cases: list[dict[str, Any]] = [
        {"json": {}},
        {"json": {"embedding": descriptor, "template": "AAAA"}},
        {"json": {"embedding": descriptor, "levle": "fmr-1e-2"}},
        {"json": {"embedding": descriptor, "face": "largest"}},
        {"json": {"template": 5}},
        {"files": images(photo(1), name="photo")},
        {"files": images(photo(1), name="image"), "data": {"attributes": "{}"}},
        {"files": images(photo(1), name="image"), "data": {"face": "all"}},
    ]
    for case in cases:
        assert_error(ask(client, sender, **case), 422, "validation_failed")


def test_a_retired_master_key_does_not_tell_who_is_enrolled(tmp_path: Path) -> None:
    own = deploy(tmp_path)
    with Client(create_app(own.settings), headers=bearer(own.token)) as client:
        assert client.put("/v1/subjects/a/enrollment", files=images(photo(1))).status_code == 201
        path = own.settings.resolved_master_key_file
        current = MasterKeyring.add_current(path)
        rewrap_keys(client.app.state.runtime.store)
        MasterKeyring.drop_retired(path, keep=current)
        token = own.key("verify")
        for subject, decision in (("a", "accept"), ("nobody", "reject")):
            answer = ask(client, token, subject, files=images(photo(1, 4), name="image"))
            assert answer.status_code == 200, answer.text
            assert answer.json()["decision"] == decision
