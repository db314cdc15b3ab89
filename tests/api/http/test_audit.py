"""Every call that does something, or is refused to, leaves a line; none of them names a face."""

import json
from typing import Any

import pytest

from api.http.schemas import AuditLogAnswer
from templates.store.audit_log import AuditLog, Line
from tests.api.calls import b64, lifted
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.shapes import assert_answer, assert_error


def lines(client: Client, after: int = 0) -> list[Line]:
    log: AuditLog = client.app.state.runtime.store.audit_log
    return list(log.lines(after=after))


def last(client: Client) -> Line:
    return lines(client)[-1]


@pytest.fixture
def service(both: tuple[Client, Deployment]) -> tuple[Client, Deployment]:
    client, _ = both
    answer = client.put("/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)))
    assert answer.status_code == 201
    return both


def test_what_is_done_is_written_with_who_did_it(service: tuple[Client, Deployment]) -> None:
    client, deployment = service
    deployment.allow_templates()
    store = client.app.state.runtime.store
    path = "/v1/subjects/alice"
    pseudonym = store.signer.pseudonym("default", "alice")
    rejected = photo(2, 5)
    exported = client.get(f"{path}/export").json()["export"]
    calls: list[tuple[str, str, Any]] = [
        ("enroll", "replaced", client.put(f"{path}/enrollment", files=images(photo(1)))),
        (
            "enroll",
            "replaced",
            client.put(f"{path}/enrollment", json={"template": b64(lifted(deployment))}),
        ),
        ("verify", "reject", client.post(f"{path}/verify", files=images(rejected, name="image"))),
        ("export", "exported", client.get(f"{path}/export")),
        ("import", "replaced", client.post("/v1/subjects/import", json={"export": exported})),
        ("erase", "erased", client.delete(path)),
        ("erase", "receipt_repeated", client.delete(path)),
        ("lockout-reset", "nothing_held", client.delete(f"{path}/lockout")),
    ]
    answers = [answer for _, _, answer in calls]
    assert all(answer.is_success for answer in answers)
    written = [line for line in lines(client) if line.pseudonym == pseudonym]
    # The fixture's enrollment and the export above come first.
    assert [(line.action, line.outcome) for line in written[2:]] == [
        (action, outcome) for action, outcome, _ in calls
    ]
    prefix = deployment.token[3:15]
    for line, answer in zip(written[2:], answers, strict=True):
        assert line.actor == f"key:{prefix}"
        assert line.tenant == "default"
        assert line.request_id == answer.headers["x-request-id"]


def test_who_administers_reads_the_log_of_the_tenant(
    service: tuple[Client, Deployment],
) -> None:
    client, deployment = service
    client.post("/v1/subjects/alice/verify", files=images(photo(2, 5), name="image"))
    store = client.app.state.runtime.store
    written = [line for line in lines(client) if line.tenant == "default"][::-1]
    seen: list[dict[str, Any]] = []
    cursor: dict[str, str] = {}
    while True:
        page = assert_answer(
            client.get("/v1/audit-log", params={"limit": "2", **cursor}), 200, AuditLogAnswer
        )
        seen += page["lines"]
        if page["next_cursor"] is None:
            break
        cursor = {"cursor": page["next_cursor"]}
    names = ("actor", "action", "outcome", "detail", "request_id")
    assert [[told[name] for name in names] for told in seen] == [
        [getattr(line, name) for name in names] for line in written
    ]
    assert [told["subject"] for told in seen] == [line.pseudonym for line in written]
    assert "alice" not in json.dumps(seen)
    about = client.get("/v1/audit-log?subject_id=alice").json()["lines"]
    pseudonym = store.signer.pseudonym("default", "alice")
    assert [told["action"] for told in about] == ["verify", "enroll"]
    assert {told["subject"] for told in about} == {pseudonym}
    # Another tenant reads its own, and no cursor of this one.
    store.tenants.create("elsewhere")
    other = bearer(store.api_keys.create("elsewhere", ("admin",)).token)
    told = client.get("/v1/audit-log", headers=other).json()["lines"]
    assert not {each["request_id"] for each in told} & {each["request_id"] for each in seen[:1]}
    assert {each["action"] for each in told}.isdisjoint({"enroll", "verify"})
    refused = client.get("/v1/audit-log", params=cursor, headers=other)
    assert_error(refused, 422, "validation_failed")
    for bad in ("subject_id=.", "cursor=1", "limit=0"):
        assert_error(client.get(f"/v1/audit-log?{bad}"), 422, "validation_failed")
    verifier = bearer(deployment.key("verify", "enroll"))
    assert_error(client.get("/v1/audit-log", headers=verifier), 403, "forbidden")


def test_refusals_are_written_with_their_code(service: tuple[Client, Deployment]) -> None:
    client, deployment = service
    path = "/v1/subjects/alice"
    verifier = deployment.key("verify", "embeddings")
    asked = {"subject_id": "alice", "action": "verify"}
    once = client.post("/v1/tokens", json=asked, headers=bearer(verifier)).json()["token"]

    def send(token: str = verifier, **options: Any) -> Any:
        return client.post(f"{path}/verify", headers=bearer(token), **options)

    cases: list[tuple[str, str, Any]] = [
        ("enroll", "forbidden", lambda: client.put(f"{path}/enrollment", headers=bearer(verifier))),
        ("erase", "forbidden", lambda: client.delete(path, headers=bearer(verifier))),
        ("export", "forbidden", lambda: client.get(f"{path}/export", headers=bearer(verifier))),
        (
            "lockout-reset",
            "forbidden",
            lambda: client.delete(f"{path}/lockout", headers=bearer(verifier)),
        ),
        ("audit-log", "forbidden", lambda: client.get("/v1/audit-log", headers=bearer(verifier))),
        (
            "list-subjects",
            "forbidden",
            lambda: client.get("/v1/subjects", headers=bearer(verifier)),
        ),
        ("get-subject", "not_enrolled", lambda: client.get("/v1/subjects/alice2")),
        (
            "create-challenge",
            "validation_failed",
            lambda: client.post("/v1/challenges", json={"x": 1}),
        ),
        ("check-photo", "malformed_request", lambda: client.post("/v1/photos/check", json={})),
        ("audit-log", "validation_failed", lambda: client.get("/v1/audit-log?cursor=1")),
        ("verify", "unsupported_image", lambda: send(files=images(b"no picture", name="image"))),
        ("verify", "accept", lambda: send(once, files=images(photo(1, 5), name="image"))),
        ("verify", "replayed", lambda: send(once, files=images(photo(1, 5), name="image"))),
    ]
    for _ in range(5):
        cases.append(("verify", "reject", lambda: send(files=images(photo(2, 5), name="image"))))
    cases.append(("verify", "locked_out", lambda: send(files=images(photo(1), name="image"))))
    for action, outcome, call in cases:
        before = last(client).sequence
        answer = call()
        new = lines(client, after=before)
        assert [(line.action, line.outcome) for line in new] == [(action, outcome)], answer.text
        assert new[0].request_id == answer.headers["x-request-id"]


def test_strangers_and_readers_write_nothing(service: tuple[Client, Deployment]) -> None:
    client, _ = service
    before = last(client).sequence
    nobody = bearer("vf_000000000000_" + "0" * 64)
    for call in (
        lambda: client.get("/v1/subjects/alice"),
        lambda: client.get("/v1/subjects"),
        lambda: client.get("/v1/audit-log"),
        lambda: client.get("/v1/audit-log?subject_id=alice"),
        lambda: client.get("/v1/contract"),
        lambda: client.get("/health/ready"),
        lambda: client.delete("/v1/subjects/alice", headers=nobody),
        lambda: client.put("/v1/subjects/alice/enrollment", headers=nobody),
    ):
        call()
    assert last(client).sequence == before


def test_a_decision_that_cannot_be_recorded_is_not_told(
    service: tuple[Client, Deployment], monkeypatch: pytest.MonkeyPatch
) -> None:
    from templates.errors import StoreUnavailable

    client, _ = service
    log = client.app.state.runtime.store.audit_log

    def full(*_: object) -> None:
        raise StoreUnavailable("the SQLite database does not answer: database or disk is full")

    before = last(client).sequence
    with monkeypatch.context() as patch:
        patch.setattr(log, "append", full)
        for method, path, options in (
            ("POST", "/v1/subjects/alice/verify", {"files": images(photo(1, 4), name="image")}),
            ("POST", "/v1/compare", {"files": images(photo(1), photo(1, 4))}),
            ("PUT", "/v1/subjects/alice/enrollment", {"files": images(photo(2))}),
            ("DELETE", "/v1/subjects/alice", {}),
            ("GET", "/v1/subjects/alice/export", {}),
        ):
            answer = client.request(method, path, **options)
            assert answer.status_code == 503
            assert answer.json()["error"]["code"] == "store_unavailable"
            assert int(answer.headers["retry-after"]) > 0
            assert "accept" not in answer.text
    assert last(client).sequence == before
    accepted = client.post("/v1/subjects/alice/verify", files=images(photo(1, 4), name="image"))
    assert accepted.json()["decision"] == "accept"
