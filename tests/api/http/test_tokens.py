"""Tokens for browsers: what one is good for, what it is refused for, and what a thief has of it."""

import base64
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from api.http.app import create_app
from api.http.requests import LONGEST_S
from api.http.routes.challenges import LIFETIME_S
from api.http.schemas import (
    ContractAnswer,
    EnrollmentAnswer,
    TokenAnswer,
    TokenOutcomeAnswer,
    VerifyAnswer,
)
from api.http.tokens import SubjectToken, ends_in
from api.service.opening import open_keyring, open_store
from templates.keys.holder_key import decode_holder_key
from templates.store import archive_audit_log
from templates.store.audit_archive import TOKENS_LAST
from templates.store.lockout import Replayed
from tests.api.calls import b64, probe
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.shapes import assert_answer, assert_error
from tests.patience import wait_until

Service = tuple[Client, Deployment]
LAX, STRICT = "fmr-1e-2", "fmr-1e-3"  # the contract's default is the strict one


def issue(client: Client, action: str = "verify", subject: str = "alice", **more: Any) -> Any:
    options = {"headers": more.pop("headers")} if "headers" in more else {}
    body = {"subject_id": subject, "action": action, **more}
    return assert_answer(client.post("/v1/tokens", json=body, **options), 201, TokenAnswer)


def verify(
    client: Client, token: str, person: int = 1, subject: str = "alice", **options: Any
) -> httpx.Response:
    headers = {**bearer(token), **options.pop("headers", {})}
    files = images(photo(person, 5), name="image")
    path = f"/v1/subjects/{subject}/verify"
    answer: httpx.Response = client.post(path, files=files, headers=headers, **options)
    return answer


def enroll(
    client: Client, token: str, person: int = 3, subject: str = "carol", **headers: str
) -> httpx.Response:
    answer: httpx.Response = client.put(
        f"/v1/subjects/{subject}/enrollment",
        files=images(photo(person)),
        headers={**bearer(token), **headers},
    )
    return answer


def outcome(client: Client, issued: Any, subject: str = "alice", **options: Any) -> Any:
    answer = client.get(f"/v1/subjects/{subject}/tokens/{issued['token_id']}", **options)
    return assert_answer(answer, 200, TokenOutcomeAnswer)


def at_once(count: int, call: Any) -> list[httpx.Response]:
    answers: list[httpx.Response] = []
    start = threading.Barrier(count)

    def one(number: int) -> None:
        start.wait()
        answers.append(call(number))

    threads = [threading.Thread(target=one, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answers


@pytest.fixture
def service(both: Service) -> Service:
    """A fresh service on each database, with ``alice`` enrolled."""
    client, _ = both
    answer = client.put("/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)))
    assert answer.status_code == 201
    return both


@pytest.fixture(scope="module")
def shared(client: Client, deployment: Deployment) -> Service:
    """The module's service on SQLite, with ``alice`` enrolled."""
    answer = client.put("/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)))
    assert answer.status_code == 201
    return client, deployment


def test_a_token_is_good_for_one_decision(service: Service) -> None:
    client, _ = service
    for person, decision in ((1, "accept"), (2, "reject")):
        issued = issue(client)
        before = outcome(client, issued)
        assert before["used"] is False
        assert [before[name] for name in ("outcome", "level", "used_at")] == [None] * 3
        body = assert_answer(verify(client, issued["token"], person), 200, VerifyAnswer)
        assert (body["decision"], body["level"]) == (decision, STRICT)
        assert_error(verify(client, issued["token"], person), 401, "replayed")
        told = outcome(client, issued)
        assert (told["used"], told["outcome"], told["level"]) == (True, decision, STRICT)


def test_a_token_is_good_for_one_enrollment(service: Service) -> None:
    client, _ = service
    issued = issue(client, "enroll", "carol")
    assert issued["level"] is None
    assert assert_answer(enroll(client, issued["token"]), 201, EnrollmentAnswer)
    # Not even the same photos, and nobody else's.
    for person in (3, 4):
        assert_error(enroll(client, issued["token"], person), 401, "replayed")
    assert outcome(client, issued, "carol")["outcome"] == "created"
    assert verify(client, issue(client, "verify", "carol")["token"], 3, "carol").json()["decision"]
    again = issue(client, "enroll", "carol")
    assert enroll(client, again["token"]).status_code == 200
    assert outcome(client, again, "carol")["outcome"] == "replaced"


def test_a_token_for_a_first_enrollment_replaces_nobody(service: Service) -> None:
    client, _ = service
    tokens = [issue(client, "enroll", "carol", replace=False) for _ in range(2)]
    refused = enroll(client, tokens[0]["token"], **{"If-Match": '"' + "0" * 32 + '"'})
    assert assert_error(refused, 403, "forbidden") == {"token": "replace"}
    first = assert_answer(enroll(client, tokens[0]["token"]), 201, EnrollmentAnswer)
    for headers in ({}, {"If-None-Match": "*"}):
        refused = enroll(client, tokens[1]["token"], 4, **headers)
        told = assert_error(refused, 409, "enrollment_conflict")
        assert told == {"template_id": first["template_id"]}
    assert outcome(client, tokens[1], "carol")["outcome"] is None
    assert enroll(client, issue(client, "enroll", "carol", replace=True)["token"]).json()[
        "replaced"
    ]


@pytest.mark.parametrize("action", ["verify", "enroll"])
def test_of_eight_uses_at_once_one_passes(service: Service, action: str) -> None:
    """In two processes' worth of services on one database, and after both are opened anew."""
    client, deployment = service
    with Client(create_app(deployment.settings)) as beside:
        token = issue(client, action)["token"]
        use = verify if action == "verify" else enroll
        answers = at_once(8, lambda i: use((client, beside)[i % 2], token, 1, "alice"))
    assert sorted(answer.status_code for answer in answers) == [200] + [401] * 7
    for answer in answers:
        if answer.status_code == 401:
            assert_error(answer, 401, "replayed")
    with Client(create_app(deployment.settings)) as restarted:
        assert_error(use(restarted, token, 1, "alice"), 401, "replayed")


def test_an_archive_does_not_make_a_used_token_good_again(service: Service, tmp_path: Path) -> None:
    client, deployment = service
    assert timedelta(seconds=max(LONGEST_S, LIFETIME_S)) < TOKENS_LAST
    issued = issue(client)
    assert verify(client, issued["token"]).status_code == 200
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        use = store.audit_log.head().sequence
        moved = archive_audit_log(store, tmp_path / "archive", through=None)
        assert moved.last.sequence == use - 1
    finally:
        store.close()
    assert_error(verify(client, issued["token"]), 401, "replayed")


def test_a_token_outlives_a_restart_and_its_key_does_not(service: Service) -> None:
    client, deployment = service
    key = deployment.key("verify")
    kept, revoked = (issue(client, headers=bearer(key))["token"] for _ in range(2))
    with Client(create_app(deployment.settings)) as restarted:
        assert verify(restarted, kept).json()["decision"] == "accept"
        assert_error(verify(client, kept), 401, "replayed")
        store = open_store(deployment.settings, open_keyring(deployment.settings))
        try:
            assert store.api_keys.revoke(key[3:15])
        finally:
            store.close()
        assert_error(verify(restarted, revoked), 401, "unauthorized")
    assert_error(verify(client, revoked), 401, "unauthorized")


def test_a_late_token_is_refused(shared: Service) -> None:
    client, deployment = shared
    issued = issue(client, lifetime_s=1)
    ends = datetime.fromisoformat(issued["expires_at"])
    wait_until(lambda: datetime.now(UTC) > ends, what="the token's end")
    before = len(audit(deployment))
    assert_error(verify(client, issued["token"]), 401, "replayed")
    for path in ("/v1/contract", "/v1/pack"):
        assert_error(client.get(path, headers=bearer(issued["token"])), 401, "replayed")
    erasure = client.delete("/v1/subjects/alice", headers=bearer(issued["token"]))
    assert_error(erasure, 401, "replayed")
    # An old token that somebody finds writes nothing to the audit log.
    assert len(audit(deployment)) == before
    assert outcome(client, issued)["used"] is False


def test_a_token_is_for_its_subject_action_and_level_only(shared: Service) -> None:
    client, _ = shared
    client.put("/v1/subjects/bob/enrollment", files=images(photo(2)))
    lax, strict = issue(client, level=LAX)["token"], issue(client, level=STRICT)["token"]
    for token, level in ((strict, LAX), (lax, STRICT), (lax, "accuracy")):
        refused = verify(client, token, data={"level": level})
        assert assert_error(refused, 403, "forbidden") == {"token": "level"}
    refused = verify(client, strict, 2, "bob")
    assert assert_error(refused, 403, "forbidden") == {"token": "subject"}
    refused = enroll(client, strict, 1, "alice")
    assert assert_error(refused, 403, "forbidden") == {"token": "call"}
    writing = issue(client, "enroll")["token"]
    refused = verify(client, writing)
    assert assert_error(refused, 403, "forbidden") == {"token": "call"}
    assert assert_error(enroll(client, writing, 2, "bob"), 403, "forbidden") == {"token": "subject"}
    # None of it used a token up, and its own level may be named.
    assert verify(client, lax, data={"level": LAX}).json()["level"] == LAX
    assert verify(client, strict).json()["level"] == STRICT
    assert enroll(client, writing, 1, "alice").status_code == 200


def test_no_other_call_takes_a_token(shared: Service) -> None:
    client, _ = shared
    document = client.get("/v1/openapi.json").json()
    taken = {
        "enroll", "verify", "createChallenge", "getContract", "getGenerator", "listPack",
        "getPackFile",
    }  # fmt: skip
    tokens = [issue(client, action)["token"] for action in ("verify", "enroll")]
    seen = set()
    for path, entry in document["paths"].items():
        for method, operation in entry.items():
            if operation["operationId"] in taken or "security" not in operation:
                continue
            seen.add(operation["operationId"])
            at = path.replace("{subject_id}", "alice").replace("{token_id}", "x")
            for token in tokens:
                refused = client.request(method.upper(), at, headers=bearer(token))
                assert assert_error(refused, 403, "forbidden") == {"token": "call"}
    assert {"eraseSubject", "createToken", "getSubject", "exportSubject", "checkPhoto"} <= seen


def test_what_a_token_may_read(shared: Service) -> None:
    client, deployment = shared
    plain = deployment.key("verify")
    token = issue(client, headers=bearer(plain))["token"]
    assert_answer(client.get("/v1/contract", headers=bearer(token)), 200, ContractAnswer)
    refused = client.get("/v1/contract/generator", headers=bearer(token))
    assert assert_error(refused, 403, "forbidden") == {"missing": ["embeddings"]}
    lifting = issue(client)["token"]
    assert client.get("/v1/contract/generator", headers=bearer(lifting)).status_code == 200
    assert verify(client, lifting).status_code == 200


def test_a_token_tells_no_distance_and_not_who_is_enrolled(shared: Service) -> None:
    client, _ = shared  # of a key with all rights
    body = verify(client, issue(client)["token"]).json()
    unknown = verify(client, issue(client, subject="nobody")["token"], subject="nobody").json()
    assert set(body) == set(unknown)
    assert "distance" not in body
    assert (unknown["decision"], unknown["reason"]) == ("reject", "no_match")


def test_a_token_is_good_for_one_embedding_or_template(shared: Service) -> None:
    client, deployment = shared
    numbers = client.app.state.runtime.pack.embed_photo(photo(1, 5)).embedding.tolist()
    template = {"template": b64(probe(deployment, numbers))}
    for sent in ({"embedding": numbers}, {"embeddings": [numbers]}, template):
        headers = bearer(issue(client)["token"])
        path = "/v1/subjects/alice/verify"
        assert client.post(path, json=sent, headers=headers).json()["decision"] == "accept"
        assert_error(client.post(path, json=sent, headers=headers), 401, "replayed")


def test_embeddings_need_the_right_of_the_key(shared: Service) -> None:
    client, deployment = shared
    numbers = client.app.state.runtime.pack.embed_photo(photo(1, 5)).embedding.tolist()
    template = b64(probe(deployment, numbers))
    for action, call, method, sent in (
        ("verify", "verify", "POST", {"embedding": numbers}),
        ("enroll", "enrollment", "PUT", {"template": template}),
    ):
        token = issue(client, action, headers=bearer(deployment.key(action)))["token"]
        path = f"/v1/subjects/alice/{call}"
        refused = client.request(method, path, json=sent, headers=bearer(token))
        assert assert_error(refused, 403, "forbidden") == {"missing": ["embeddings"]}


def test_a_theft_of_an_answered_request_gives_nothing(service: Service) -> None:
    client, _ = service
    used, writing = issue(client)["token"], issue(client, "enroll", "carol")["token"]
    assert verify(client, used).json()["decision"] == "accept"
    assert enroll(client, writing).status_code == 201
    assert_error(verify(client, used), 401, "replayed")
    for person in (1, 2):
        assert_error(verify(client, used, person, "carol"), 403, "forbidden")
        assert_error(enroll(client, writing, person), 401, "replayed")
    # Nor what a client needs before: the token is good for nothing any more.
    for token in (used, writing):
        for path in ("/v1/contract", "/v1/contract/generator", "/v1/pack", f"/v1/pack/{'0' * 64}"):
            assert_error(client.get(path, headers=bearer(token)), 401, "replayed")
    asked = client.post("/v1/challenges", json={}, headers=bearer(used))
    assert_error(asked, 401, "replayed")
    # One bit of it changed is no token: neither its end, its subject nor its level can be moved.
    _, prefix, sealed = used.split("_", 2)
    raw = bytearray(base64.urlsafe_b64decode(sealed + "=" * (-len(sealed) % 4)))
    for at in (0, 5, 15, 30, len(raw) // 2, len(raw) - 1):
        altered = bytes(raw[:at]) + bytes([raw[at] ^ 1]) + bytes(raw[at + 1 :])
        text = base64.urlsafe_b64encode(altered).decode().rstrip("=")
        assert_error(verify(client, f"vft_{prefix}_{text}"), 401, "unauthorized")
    # Under the prefix of another key it does not open.
    other = issue(client, headers=bearer(client.headers["Authorization"][7:]))["token"]
    assert other[4:16] == prefix
    assert_error(verify(client, f"vft_{'0' * 12}_{sealed}"), 401, "unauthorized")
    assert verify(client, other).json()["decision"] == "accept"


def test_a_theft_of_an_earlier_request_gives_the_one_call(shared: Service) -> None:
    """A token that no decision and no enrollment used up is whole, whoever holds it."""
    client, _ = shared
    token, writing = issue(client)["token"], issue(client, "enroll", "erin")["token"]
    for held in (token, writing):
        assert client.get("/v1/contract", headers=bearer(held)).status_code == 200
    no_photo = images(b"no photo", name="image")
    refused = client.post("/v1/subjects/alice/verify", files=no_photo, headers=bearer(token))
    assert_error(refused, 400, "unsupported_image")
    refused = client.put(
        "/v1/subjects/erin/enrollment", files=images(photo(3), photo(4)), headers=bearer(writing)
    )
    assert_error(refused, 422, "inconsistent_images")
    assert verify(client, token, 2).json()["decision"] == "reject"  # the thief's
    assert enroll(client, writing, 4, "erin").status_code == 201
    assert_error(verify(client, token), 401, "replayed")  # and nothing is left for the visitor
    assert_error(enroll(client, writing, 3, "erin"), 401, "replayed")


def test_a_holders_key_is_forgotten_where_nothing_is_decided(
    shared: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, _ = shared
    keys: list[bytearray] = []

    def decoded(text: str) -> bytearray:
        keys.append(decode_holder_key(text))
        return keys[-1]

    monkeypatch.setattr("api.http.requests.decode_holder_key", decoded)
    sent = {"holder_key": base64.urlsafe_b64encode(bytes(range(32))).decode()}
    for call, field, method in (("verify", "image", "POST"), ("enrollment", "images", "PUT")):
        for data in (photo(1), b"no photo"):
            client.request(
                method, f"/v1/subjects/wiped/{call}", files=images(data, name=field), data=sent
            )
    assert len(keys) == 4
    assert [bytes(key) for key in keys] == [bytes(32)] * len(keys) != []


def test_a_token_that_ends_while_its_body_comes_is_refused(
    shared: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, deployment = shared
    for use, action in ((verify, "verify"), (enroll, "enroll")):
        issued = issue(client, action)
        late = Mock(side_effect=[None, Replayed(recorded=True)])
        monkeypatch.setattr(SubjectToken, "require_in_time", late)
        before = len(audit(deployment))
        assert_error(use(client, issued["token"], 1, "alice"), 401, "replayed")
        assert len(audit(deployment)) == before
        monkeypatch.undo()
        assert outcome(client, issued)["used"] is False


def test_the_master_key_alone_makes_no_token(shared: Service) -> None:
    client, deployment = shared
    token = SubjectToken(
        subject="alice",
        action="enroll",
        level=None,
        key_prefix=deployment.token[3:15],
        expires_at=ends_in(LONGEST_S),
    )
    forged = token.text(open_keyring(deployment.settings), key_id="0" * 32)
    assert_error(enroll(client, forged, 2, "alice"), 401, "unauthorized")


def test_who_may_ask_for_which_token(shared: Service) -> None:
    client, deployment = shared
    for key, action, missing in (
        (deployment.key("verify"), "enroll", "enroll"),
        (deployment.key("enroll"), "verify", "verify"),
        (deployment.key("scores", "erase"), "verify", "verify"),
    ):
        body = {"subject_id": "alice", "action": action}
        refused = client.post("/v1/tokens", json=body, headers=bearer(key))
        assert assert_error(refused, 403, "forbidden") == {"missing": [missing]}
    good = {"subject_id": "alice", "action": "verify"}
    for change, code in (
        ({"subject_id": None}, "validation_failed"),
        ({"subject_id": "a/b"}, "validation_failed"),
        ({"action": "erase"}, "validation_failed"),
        ({"action": ["verify"]}, "validation_failed"),
        ({"lifetime_s": 121}, "validation_failed"),
        ({"lifetime_s": 0}, "validation_failed"),
        ({"lifetime_s": 1.5}, "validation_failed"),
        ({"lifetime_s": True}, "validation_failed"),
        ({"action": "enroll", "level": STRICT}, "validation_failed"),
        ({"level": "fmr-1e-9"}, "uncalibrated"),
        ({"lvel": STRICT}, "validation_failed"),
        ({"replace": False}, "validation_failed"),
        ({"action": "enroll", "replace": "no"}, "validation_failed"),
    ):
        assert_error(client.post("/v1/tokens", json={**good, **change}), 422, code)


def test_the_lowest_level_of_the_key_holds(shared: Service) -> None:
    client, deployment = shared
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        key = store.api_keys.create("default", ["verify"], lowest_level=STRICT).token
    finally:
        store.close()
    body = {"subject_id": "alice", "action": "verify", "level": LAX}
    refused = client.post("/v1/tokens", json=body, headers=bearer(key))
    assert assert_error(refused, 403, "forbidden") == {"lowest_level": STRICT}
    assert issue(client, headers=bearer(key))["level"] == STRICT


def test_the_outcome_is_told_to_the_key_that_asked(service: Service) -> None:
    client, deployment = service
    mine, others = deployment.key("verify"), deployment.key("verify")
    issued = issue(client, headers=bearer(mine))
    assert verify(client, issued["token"]).json()["decision"] == "accept"
    assert outcome(client, issued, headers=bearer(mine))["outcome"] == "accept"
    assert not outcome(client, issued, headers=bearer(others))["used"]
    # A page that shows the token of another person is found out.
    assert not outcome(client, issued, "bob", headers=bearer(mine))["used"]


def audit(deployment: Deployment) -> list[Any]:
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        return list(store.audit_log.lines())
    finally:
        store.close()


def test_the_audit_log_and_the_metrics_tell_of_tokens(service: Service) -> None:
    client, deployment = service
    issued = issue(client)
    verify(client, issued["token"])
    verify(client, issued["token"])
    verify(client, issued["token"], subject="bob")
    lines = audit(deployment)[-4:]
    assert [(line.action, line.outcome) for line in lines] == [
        ("token", "issued"), ("verify", "accept"), ("verify", "replayed"), ("verify", "forbidden"),
    ]  # fmt: skip
    assert lines[0].detail == f"verify {issued['token_id']}"
    assert len({(line.actor, line.pseudonym) for line in lines}) == 1
    text = client.get("/metrics").text
    assert 'veilface_tokens_total{action="verify"}' in text
