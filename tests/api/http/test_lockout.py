"""Guessing through the API stops at the lockout, whoever guesses and whomever."""

import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.schemas import LockoutAnswer, UnlockAnswer
from templates.store.lockout import LockoutPolicy
from tests.api.calls import AFTER, attempt, enroll, fail
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.shapes import assert_answer, assert_error
from tests.databases import migrate_ahead

FIRST_S = 3600


@pytest.fixture
def both(
    tmp_path: Path, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Client, Deployment]]:
    """As elsewhere, with locks that outlast every test, however long a busy machine takes."""
    migrate_ahead(database_url)
    monkeypatch.setattr("api.service.opening.LOCKOUT", LockoutPolicy(first_s=FIRST_S))
    deployment = deploy(tmp_path, database_url=database_url)
    with Client(create_app(deployment.settings)) as running:
        running.headers.update(bearer(deployment.token))
        yield running, deployment


def test_a_subject_locks_and_the_right_face_waits_too(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    fail(client, token, AFTER)
    for person in (1, 2):
        answer = attempt(client, token, person)
        assert assert_error(answer, 423, "locked_out") == {"disabled": False}
        assert FIRST_S // 2 < int(answer.headers["retry-after"]) <= FIRST_S


def test_an_unknown_subject_locks_in_the_same_words(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    for subject in ("alice", "nobody"):
        fail(client, token, AFTER, subject)
    answers = []
    for subject in ("alice", "nobody"):
        answer = attempt(client, token, 1, subject).json()
        del answer["request_id"]
        # The locks began one after the other: only the seconds that are left differ.
        answers.append(re.sub(r"\d+", "N", json.dumps(answer)))
    assert answers[0] == answers[1]
    assert "locked_out" in answers[0]


def test_the_count_is_the_subjects_not_the_keys(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    enroll(client)
    enroll(client, "bob", 3)
    keys = [deployment.key("verify") for _ in range(AFTER)]
    for token in keys:
        fail(client, token, 1)
    fresh = deployment.key("verify")
    assert_error(attempt(client, fresh, 1), 423, "locked_out")
    assert attempt(client, keys[0], 3, "bob").json()["decision"] == "accept"


@pytest.mark.parametrize("subject", ["alice", "nobody"])
def test_a_locked_subjects_photo_is_not_looked_at(
    both: tuple[Client, Deployment], subject: str
) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    path, no_picture = f"/v1/subjects/{subject}/verify", images(b"no picture", name="image")
    refused = client.post(path, files=no_picture, headers=bearer(token))
    assert_error(refused, 400, "unsupported_image")
    fail(client, token, AFTER, subject)
    refused = client.post(path, files=no_picture, headers=bearer(token))
    assert_error(refused, 423, "locked_out")


def test_an_accept_sets_the_count_back(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    for _ in range(3):
        fail(client, token, AFTER - 1)
        assert attempt(client, token, 1).json()["decision"] == "accept"


def test_what_is_no_comparison_does_not_count(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify", "embeddings")
    path = "/v1/subjects/alice/verify"
    for _ in range(2 * AFTER):
        client.post(path, files=images(b"no picture", name="image"), headers=bearer(token))
        client.post(path, json={"embedding": [1.0]}, headers=bearer(token))
        client.post(path, json={"embedding": [0.0] * 64}, headers=bearer(token))
    assert attempt(client, token, 1).json()["decision"] == "accept"


def test_attempts_at_once_are_answered_no_more_often(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    enroll(client)
    # A key may hold half of the places at most.
    tokens = [deployment.key("verify", "embeddings") for _ in range(2)]
    stranger = client.app.state.runtime.pack.embed_photo(photo(2, 5)).embedding
    answers: list[Any] = []
    start = threading.Barrier(24)

    def one(token: str) -> None:
        start.wait()
        body = {"embedding": stranger.tolist()}
        answers.append(client.post("/v1/subjects/alice/verify", json=body, headers=bearer(token)))

    threads = [threading.Thread(target=one, args=(tokens[n % 2],)) for n in range(24)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    statuses = sorted(answer.status_code for answer in answers)
    assert statuses == [200] * AFTER + [423] * (24 - AFTER)


def test_the_lock_outlives_a_restart_and_an_operator_lifts_it(
    both: tuple[Client, Deployment],
) -> None:
    client, deployment = both
    enroll(client)
    token, desk = deployment.key("verify"), deployment.key("admin")
    fail(client, token, AFTER)
    path = "/v1/subjects/alice/lockout"
    with Client(create_app(deployment.settings)) as other:
        assert_error(attempt(other, token, 1), 423, "locked_out")
        seen = assert_answer(other.get(path, headers=bearer(desk)), 200, LockoutAnswer)
        assert seen["consecutive_failures"] == AFTER
        assert seen["locked_until"] is not None
        assert seen["disabled_at"] is None
        assert_error(other.delete(path, headers=bearer(token)), 403, "forbidden")
        lifted: list[Any] = []
        for _ in range(2):
            lifted.append(other.delete(path, headers=bearer(desk)))
        assert [assert_answer(each, 200, UnlockAnswer)["lifted"] for each in lifted] == [
            True,
            False,
        ]
        assert_error(other.get(path, headers=bearer(desk)), 404, "not_found")
    assert attempt(client, token, 1).json()["decision"] == "accept"


def test_a_disabled_subject_waits_for_an_operator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = LockoutPolicy(first_s=1e-6, longest_s=1e-6, disable_at=6)
    monkeypatch.setattr("api.service.opening.LOCKOUT", policy)
    own = deploy(tmp_path, lockout_after=3)
    with Client(create_app(own.settings), headers=bearer(own.token)) as client:
        enroll(client)
        token = own.key("verify")
        fail(client, token, 6)
        answer = attempt(client, token, 1)
        assert assert_error(answer, 423, "locked_out") == {"disabled": True}
        assert int(answer.headers["retry-after"]) > 0
        assert client.delete("/v1/subjects/alice/lockout").status_code == 200
        assert attempt(client, token, 1).json()["decision"] == "accept"
