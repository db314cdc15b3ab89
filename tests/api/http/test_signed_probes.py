"""A probe that was captured cannot be sent again."""

import threading
import time
from typing import Any

import pytest

from api.http.schemas import VerifyAnswer
from templates.keys.probe_signature import sign_probe, signed_probe
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.http.test_verification import probe
from tests.api.shapes import assert_answer, assert_error

PATH = "/v1/subjects/alice/verify"


@pytest.fixture
def service(both: tuple[Client, Deployment]) -> tuple[Client, Deployment, str]:
    """A service with ``alice`` enrolled, and a key that may send embeddings."""
    client, deployment = both
    answer = client.put("/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)))
    assert answer.status_code == 201
    return client, deployment, deployment.key("verify", "embeddings")


def descriptor(client: Client, person: int) -> Any:
    return client.app.state.runtime.pack.embed_photo(photo(person, 5)).embedding


def send(client: Client, token: str, body: dict[str, Any], path: str = PATH) -> Any:
    return client.post(path, json=body, headers=bearer(token), sign=False)


def test_a_probe_is_good_for_one_decision(service: tuple[Client, Deployment, str]) -> None:
    client, deployment, token = service
    numbers = descriptor(client, 1)
    for sent in (numbers, probe(deployment, [float(x) for x in numbers])):
        body = signed_probe(token, "alice", sent)
        first = send(client, token, body)
        assert assert_answer(first, 200, VerifyAnswer)["decision"] == "accept"
        assert_error(send(client, token, body), 401, "replayed")
        again = signed_probe(token, "alice", sent)
        assert send(client, token, again).json()["decision"] == "accept"


def test_of_many_sendings_at_once_one_is_answered(
    service: tuple[Client, Deployment, str],
) -> None:
    client, _, token = service
    body = signed_probe(token, "alice", descriptor(client, 1))
    answers: list[Any] = []
    start = threading.Barrier(16)

    def one() -> None:
        start.wait()
        answers.append(send(client, token, body))

    threads = [threading.Thread(target=one) for _ in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answer.status_code for answer in answers) == [200] + [401] * 15


def test_a_signature_holds_for_what_was_signed_only(
    service: tuple[Client, Deployment, str],
) -> None:
    client, deployment, token = service
    numbers = descriptor(client, 1)
    good = signed_probe(token, "alice", numbers)
    other = [float(x) for x in descriptor(client, 2)]
    lifted = signed_probe(token, "alice", probe(deployment, other))
    for body in (
        {**good, "embedding": other},
        {**good, "level": "fmr-1e-2"},
        {**good, "nonce": "x" * 20},
        {**good, "timestamp": good["timestamp"] + 1},
        {**good, "hmac": "0" * 64},
        {**good, "hmac": good["hmac"].upper()},
        {**lifted, "level": "accuracy"},
    ):
        assert_error(send(client, token, body), 401, "unauthorized")
    assert_error(send(client, token, good, "/v1/subjects/bob/verify"), 401, "unauthorized")
    elsewhere = deployment.key("verify", "embeddings")
    assert_error(send(client, elsewhere, good), 401, "unauthorized")
    assert send(client, token, good).json()["decision"] == "accept"


def test_old_and_future_probes_are_refused(service: tuple[Client, Deployment, str]) -> None:
    client, deployment, token = service
    numbers = descriptor(client, 1)
    window = deployment.settings.probe_window_s
    for away, status in ((-window - 5, 401), (window + 5, 401), (-window / 2, 200)):
        signature = sign_probe(token, "alice", numbers, timestamp=int(time.time() + away))
        body = {"embedding": [float(x) for x in numbers], **signature.fields()}
        answer = send(client, token, body)
        assert answer.status_code == status
        if status == 401:
            assert_error(answer, 401, "replayed")


def test_fields_of_the_signature_are_checked(service: tuple[Client, Deployment, str]) -> None:
    client, _, token = service
    good = signed_probe(token, "alice", descriptor(client, 1))
    wrong: dict[str, list[Any]] = {
        "nonce": [None, "", "short", "x" * 65, "ä" * 20, "n" * 19 + "\n", 7, ["x" * 20]],
        "timestamp": [None, "1000", 1000.5, -1, 2**53, True, 10**400],
        "hmac": [None, "", "0" * 63, "0" * 65, "ä" * 64, 0],
    }
    for name, values in wrong.items():
        missing = {key: value for key, value in good.items() if key != name}
        details = assert_error(send(client, token, missing), 422, "validation_failed")
        assert details["field"] == name
        for value in values:
            details = assert_error(
                send(client, token, {**good, name: value}), 422, "validation_failed"
            )
            assert details["field"] == name


def test_a_probe_that_was_not_decided_keeps_its_nonce(
    service: tuple[Client, Deployment, str],
) -> None:
    client, _, token = service
    numbers = descriptor(client, 1)
    body = signed_probe(token, "alice", numbers, level="no-such-level")
    assert_error(send(client, token, body), 422, "uncalibrated")
    assert_error(send(client, token, body), 422, "uncalibrated")


def test_a_photo_needs_no_signature(service: tuple[Client, Deployment, str]) -> None:
    client, _, token = service
    for _ in range(2):
        answer = client.post(
            PATH, files=images(photo(1, 4), name="image"), headers=bearer(token), sign=False
        )
        assert answer.json()["decision"] == "accept"


def test_a_used_nonce_outlives_a_restart(
    service: tuple[Client, Deployment, str],
) -> None:
    from api.http.app import create_app

    client, deployment, token = service
    body = signed_probe(token, "alice", descriptor(client, 1))
    assert send(client, token, body).json()["decision"] == "accept"
    with Client(create_app(deployment.settings)) as other:
        assert_error(send(other, token, body), 401, "replayed")
