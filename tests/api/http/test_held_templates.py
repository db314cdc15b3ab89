"""Templates that their holders keep, over HTTP: enrolled, brought along, refused, revoked."""

import base64
from typing import Any

import pytest
import sqlalchemy as sa
from sqlalchemy import event

from api.http.schemas import EnrollmentAnswer, ReceiptAnswer, SubjectAnswer, VerifyAnswer
from models.pack import ModelPack
from templates.contract import wire
from templates.keys import sealing
from templates.space.lifting import lift
from templates.store import envelope
from templates.store.schema import Base
from tests.api.client import Client
from tests.api.deployment import Deployment, M, bearer, images, photo
from tests.api.http.test_verification import counting_cipher
from tests.api.shapes import assert_answer, assert_error
from tests.templates.store.test_erasure import pieces

AFTER = 5


def hold(client: Client, subject: str, person: int, **more: Any) -> str:
    """Enroll a subject whose holder keeps the template; return it as it is answered."""
    answer = client.put(
        f"/v1/subjects/{subject}/enrollment",
        files=images(photo(person), photo(person, 1)),
        data={"storage": "holder"},
        **more,
    )
    assert answer.status_code in (200, 201), answer.text
    EnrollmentAnswer.model_validate(answer.json())
    text: str = answer.json()["held_template"]
    return text


def attempt(
    client: Client, token: str, subject: str, person: int, held_template: str | None
) -> dict[str, Any]:
    answer = client.post(
        f"/v1/subjects/{subject}/verify",
        files=images(photo(person, 9), name="image"),
        data={} if held_template is None else {"held_template": held_template},
        headers=bearer(token),
    )
    return assert_answer(answer, 200, VerifyAnswer)


def altered(held_template: str, at: int) -> str:
    sealed = bytearray(base64.b64decode(held_template))
    sealed[at] ^= 1
    return base64.b64encode(sealed).decode()


def failures(client: Client, subject: str) -> int:
    count: int = client.get(f"/v1/subjects/{subject}/lockout").json()["consecutive_failures"]
    return count


def test_a_person_is_known_with_their_template_only(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    token = deployment.key("verify")
    held = hold(client, "alice", 1)
    path = "/v1/subjects/alice"
    described = assert_answer(client.get(path), 200, SubjectAnswer)
    assert (described["storage"], described["photos"]) == ("holder", 2)

    accepted = attempt(client, token, "alice", 1, held)
    assert (accepted["decision"], accepted["reason"]) == ("accept", "match")
    stranger = attempt(client, token, "alice", 2, held)
    alone = attempt(client, token, "alice", 1, None)
    for rejected in (stranger, alone):
        assert (rejected["decision"], rejected["reason"]) == ("reject", "no_match")
        assert set(rejected) == set(accepted)
    assert failures(client, "alice") == 2
    assert attempt(client, token, "alice", 1, held)["decision"] == "accept"

    # A probe that is not a photo brings it in the same JSON.
    embedding = client.app.state.runtime.pack.embed_photo(photo(1, 9)).embedding.tolist()
    body = {"embedding": embedding, "held_template": held}
    assert client.post(f"{path}/verify", json=body).json()["decision"] == "accept"

    for call in ("export", "stored"):
        assert_error(client.get(f"{path}/{call}"), 409, "template_not_stored")

    lines = list(client.app.state.runtime.store.audit_log.lines())
    assert [line.outcome for line in lines if line.action == "verify"] == [
        *("accept", "reject", "reject", "accept", "accept")
    ]
    sealed = base64.b64decode(held)
    runtime = client.app.state.runtime
    kept = runtime.store.database.read(_everything)
    assert len(kept) > 1000
    assert not any(piece in kept for piece in (*pieces(sealed), *pieces(held.encode())))

    receipt = assert_answer(client.delete(path), 200, ReceiptAnswer)
    claims = receipt["claims"]
    assert (claims["held"], claims["erased"][:2]) == (
        True,
        [{"item": "template", "count": 0}, {"item": "data_key", "count": 1}],
    )
    assert attempt(client, token, "alice", 1, held)["decision"] == "reject"


def _everything(connection: sa.Connection) -> bytes:
    rows = [
        row for table in Base.metadata.sorted_tables for row in connection.execute(table.select())
    ]
    values = [value for row in rows for value in row]
    return b"\n".join(v if isinstance(v, bytes) else str(v).encode() for v in values)


def test_any_other_template_is_rejected_and_counted(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    token = deployment.key("verify")
    elsewhere = bearer(deployment.key("enroll", tenant="other"))
    old = hold(client, "alice", 1)
    wrong = [
        old,  # of the enrollment before
        hold(client, "bob", 1),
        hold(client, "alice", 1, headers=elsewhere),
        "",
    ]
    held = hold(client, "alice", 1)
    wrong.append(altered(held, len(base64.b64decode(held)) // 2))
    assert len(wrong) == AFTER
    for number, sent in enumerate(wrong, start=1):
        rejected = attempt(client, token, "alice", 1, sent)
        assert (rejected["decision"], rejected["reason"]) == ("reject", "no_match")
        assert failures(client, "alice") == number
    locked = client.post(
        "/v1/subjects/alice/verify",
        files=images(photo(1, 9), name="image"),
        data={"held_template": held},
        headers=bearer(token),
    )
    assert_error(locked, 423, "locked_out")
    client.delete("/v1/subjects/alice/lockout")
    assert attempt(client, token, "alice", 1, held)["decision"] == "accept"

    # The subject that is erased and enrolled again is another one.
    client.delete("/v1/subjects/alice")
    again = hold(client, "alice", 1)
    assert attempt(client, token, "alice", 1, held)["decision"] == "reject"
    assert attempt(client, token, "alice", 1, again)["decision"] == "accept"


def test_what_is_sent_must_have_the_right_form(client: Client, deployment: Deployment) -> None:
    hold(client, "form", 1)
    path = "/v1/subjects/form/verify"
    photos = images(photo(1, 9), name="image")

    def sent(held_template: str, **more: str) -> Any:
        return client.post(path, files=photos, data={"held_template": held_template, **more})

    assert_error(sent("no base64!"), 400, "invalid_template")
    embedding = client.app.state.runtime.pack.embed_photo(photo(1, 9)).embedding.tolist()
    for value, status, code in ((7, 422, "validation_failed"), ("?", 400, "invalid_template")):
        body = {"embedding": embedding, "held_template": value}
        assert_error(client.post(path, json=body), status, code)
    # Longer than other fields, but not without a bound.
    long = base64.b64encode(bytes(3_000_000)).decode()
    assert sent(long).json()["reason"] == "no_match"
    assert_error(sent(long * 2), 400, "malformed_request")
    assert_error(sent("", level="x" * 5000), 400, "malformed_request")
    enrollment = {"files": images(photo(1)), "data": {"storage": "elsewhere"}}
    details = assert_error(
        client.put("/v1/subjects/form/enrollment", **enrollment), 422, "validation_failed"
    )
    assert details == {"field": "storage"}


def test_a_stored_template_decides_whatever_is_sent(client: Client) -> None:
    held = hold(client, "both", 1)
    path = "/v1/subjects/both"
    files, probe = images(photo(1), photo(1, 1)), images(photo(1, 9), name="image")
    answer = client.put(f"{path}/enrollment", files=files, data={"storage": "service"})
    assert_answer(answer, 200, EnrollmentAnswer)
    assert "held_template" not in answer.json()
    assert client.get(path).json()["storage"] == "service"
    for sent in ({}, {"held_template": held}, {"held_template": "AAAA"}):
        body = client.post(f"{path}/verify", files=probe, data=sent).json()
        assert body["decision"] == "accept"


def test_a_template_of_a_client_can_be_held(client: Client, deployment: Deployment) -> None:
    deployment.allow_templates()
    template = _lifted(deployment)
    body = {"template": base64.b64encode(template).decode(), "storage": "holder"}
    answer = client.put("/v1/subjects/lifted/enrollment", json=body)
    held = assert_answer(answer, 201, EnrollmentAnswer)["held_template"]
    probe = images(photo(1, 9), name="image")
    for sent, decision in ((held, "accept"), (altered(held, 20), "reject")):
        answer = client.post(
            "/v1/subjects/lifted/verify", files=probe, data={"held_template": sent}
        )
        assert answer.json()["decision"] == decision


def test_template_and_key_can_both_be_held(client: Client) -> None:
    key = base64.urlsafe_b64encode(bytes(range(32))).decode()
    path, probe = "/v1/subjects/twice", images(photo(1, 9), name="image")
    answer = client.put(
        f"{path}/enrollment",
        files=images(photo(1), photo(1, 1)),
        data={"storage": "holder", "holder_key": key},
    )
    held = assert_answer(answer, 201, EnrollmentAnswer)["held_template"]
    decisions = [
        client.post(f"{path}/verify", files=probe, data=sent).json()["decision"]
        for sent in (
            {"held_template": held, "holder_key": key},
            {"held_template": held},
            {"holder_key": key},
        )
    ]
    assert decisions == ["accept", "reject", "reject"]


def _lifted(deployment: Deployment) -> bytes:
    assert deployment.settings.pack is not None
    pack = ModelPack.load(deployment.settings.pack, threads=1)
    source = deployment.source
    points = source.project(pack.embed_photo(photo(1)).embedding[None])
    template = lift(points, strategy="adversarial", m=M, source=source)[0]
    return wire.encode(template, contract_id=deployment.contract.contract_id, dtype="float32")


def test_without_the_template_a_subject_looks_like_none(
    client: Client, deployment: Deployment
) -> None:
    """Also by the distance, which is that to the template of nobody that it had before."""
    token = deployment.key("verify", "scores")
    before = attempt(client, token, "veiled", 1, None)
    held = hold(client, "veiled", 1)
    for sent in (None, altered(held, 30)):
        answer = attempt(client, token, "veiled", 1, sent)
        del answer["request_id"]
        assert answer == {name: before[name] for name in answer}
        assert "distance" in answer
    assert attempt(client, token, "veiled", 1, held)["distance"] < before["distance"]
    # A key that may know who is enrolled is told no more of it.
    desk = deployment.key("verify", "enroll")
    assert attempt(client, desk, "veiled", 1, None)["reason"] == "no_match"


def test_a_wrong_template_costs_the_same_whoever_it_is_sent_for(
    client: Client, deployment: Deployment, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = deployment.key("verify")
    wrong = altered(hold(client, "held", 1), 40)
    client.put("/v1/subjects/stored/enrollment", files=images(photo(1), photo(1, 1)))
    engine = client.app.state.runtime.store.database.engine
    seen: list[list[str]] = []
    for subject in ("held", "stored", "unknown"):
        attempt(client, token, subject, 2, wrong)  # caches are warm
        steps: list[str] = []

        def record(_c: object, _u: object, statement: str, *rest: object) -> None:
            steps.append(statement.split("WHERE")[0])  # noqa: B023

        event.listen(engine, "before_cursor_execute", record)
        with monkeypatch.context() as patch:
            patch.setattr(envelope, "AESGCM", counting_cipher(steps))
            patch.setattr(sealing, "AESGCM", counting_cipher(steps))
            attempt(client, token, subject, 2, wrong)
        event.remove(engine, "before_cursor_execute", record)
        seen.append(steps)
    assert seen[0] == seen[1] == seen[2]
    assert sum(step.startswith("decrypt") for step in seen[0]) >= 4
