"""The holder's key over REST."""

import base64
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.schemas import (
    EnrollmentAnswer,
    ImportAnswer,
    SubjectAnswer,
    SubjectsAnswer,
    VerifyAnswer,
)
from api.service.runtime import Runtime
from templates.contract import wire
from templates.contract.document import Contract
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import lift
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.shapes import assert_answer, assert_error


def new_key() -> str:
    return base64.urlsafe_b64encode(os.urandom(32)).decode().rstrip("=")


KEY, OTHER = new_key(), new_key()


def enroll(client: Client, subject: str, key: str | None = KEY, person: int = 1) -> dict[str, Any]:
    fields = {} if key is None else {"holder_key": key}
    answer = client.put(
        f"/v1/subjects/{subject}/enrollment",
        files=images(photo(person), photo(person, 1)),
        data=fields,
    )
    return assert_answer(answer, answer.status_code, EnrollmentAnswer)


def verify(
    client: Client,
    subject: str,
    key: str | None = None,
    *,
    person: int = 1,
    headers: dict[str, str] | None = None,
) -> dict[str, Any]:
    answer = client.post(
        f"/v1/subjects/{subject}/verify",
        files=images(photo(person, 9), name="image"),
        data={} if key is None else {"holder_key": key},
        headers=headers or {},
    )
    return assert_answer(answer, 200, VerifyAnswer)


def decided(client: Client, subject: str, key: str | None = None, **options: Any) -> str:
    return str(verify(client, subject, key, **options)["decision"])


def embedding(runtime: Runtime, person: int = 1) -> list[float]:
    pack = runtime.pack
    assert pack is not None
    row = pack.embed_photo(photo(person, 9)).embedding
    return [float(number) for number in row]


def lifted(runtime: Runtime, m: int, person: int = 1) -> str:
    contract: Contract = runtime.contract
    pack, source = runtime.pack, runtime.source
    assert pack is not None
    assert source is not None
    rows = pack.embed_photo(photo(person)).embedding[None]
    points = source.project(rows)
    template = lift(points, strategy=contract.binding.strategy, m=m, source=source)[0]
    return base64.b64encode(wire.encode(template, contract_id=contract.contract_id)).decode()


def test_only_the_key_accepts(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    assert enroll(client, "anna")["holder_key"] is True
    assert decided(client, "anna", KEY) == "accept"
    assert decided(client, "anna", KEY + "=") == "accept"
    assert decided(client, "anna", KEY, person=2) == "reject"
    blind = bearer(deployment.key("verify"))
    rejections = [
        verify(client, "anna", OTHER, headers=blind),
        verify(client, "anna", headers=blind),
        verify(client, "anna", KEY, person=2, headers=blind),
        verify(client, "nobody", KEY, headers=blind),
        verify(client, "nobody", headers=blind),
    ]
    for answer in rejections:
        assert answer.pop("request_id")
    assert all(answer == rejections[0] for answer in rejections)
    assert (rejections[0]["decision"], rejections[0]["reason"]) == ("reject", "no_match")


def test_a_missing_key_counts_towards_the_lock(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, lockout_after=3)
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        enroll(client, "anna")
        for key in (None, OTHER, None):
            assert decided(client, "anna", key) == "reject"
        answer = client.post(
            "/v1/subjects/anna/verify",
            files=images(photo(1), name="image"),
            data={"holder_key": KEY},
        )
        assert_error(answer, 423, "locked_out")


def test_whether_a_key_is_needed_is_told_to_who_may_enroll(client: Client) -> None:
    enroll(client, "with")
    assert enroll(client, "without", key=None)["holder_key"] is False
    for subject, needed in (("with", True), ("without", False)):
        body = assert_answer(client.get(f"/v1/subjects/{subject}"), 200, SubjectAnswer)
        assert body["holder_key"] is needed
    page = assert_answer(client.get("/v1/subjects"), 200, SubjectsAnswer)
    needs = {entry["subject_id"]: entry["holder_key"] for entry in page["subjects"]}
    assert (needs["with"], needs["without"]) == (True, False)
    # Who needs none may send one.
    assert decided(client, "without", OTHER) == "accept"


def test_another_enrollment_takes_another_key_or_none(client: Client) -> None:
    enroll(client, "again", KEY)
    assert enroll(client, "again", OTHER)["replaced"] is True
    assert decided(client, "again", OTHER) == "accept"
    assert decided(client, "again", KEY) == "reject"
    assert enroll(client, "again", None)["holder_key"] is False
    assert decided(client, "again") == "accept"


def test_templates_embeddings_and_lifted_probes(client: Client, deployment: Deployment) -> None:
    deployment.allow_templates()
    runtime: Runtime = client.app.state.runtime
    answer = client.put(
        "/v1/subjects/lifted/enrollment",
        json={"template": lifted(runtime, runtime.contract.binding.m), "holder_key": KEY},
    )
    assert assert_answer(answer, 201, EnrollmentAnswer)["holder_key"] is True
    probes: list[dict[str, Any]] = [
        {"embedding": embedding(runtime)},
        {"embeddings": [embedding(runtime)]},
        {"template": lifted(runtime, 2)},
    ]
    for probe in probes:
        for key, expected in ((KEY, "accept"), (OTHER, "reject"), (None, "reject")):
            body = probe | ({} if key is None else {"holder_key": key})
            answer = client.post("/v1/subjects/lifted/verify", json=body)
            assert assert_answer(answer, 200, VerifyAnswer)["decision"] == expected


MALFORMED = [
    "",
    "x",
    KEY[:-1],
    KEY + "==",
    KEY + "A",
    KEY + "\n",
    "+" + KEY[1:],
    KEY[:-1] + "B",
    base64.urlsafe_b64encode(bytes(33)).decode(),
    "ä" * 43,
]


def test_malformed_keys_are_refused_and_not_repeated(
    client: Client, deployment: Deployment
) -> None:
    deployment.allow_templates()
    enroll(client, "strict")
    runtime: Runtime = client.app.state.runtime
    probe = embedding(runtime)
    wrong: list[Any] = [*MALFORMED, 5, True, [KEY], {"key": KEY}]
    for key in wrong:
        answers = [
            client.post("/v1/subjects/strict/verify", json={"embedding": probe, "holder_key": key}),
            client.put("/v1/subjects/strict/enrollment", json={"template": "", "holder_key": key}),
        ]
        if isinstance(key, str) and key.isascii() and "\n" not in key:
            answers += [
                client.put(
                    "/v1/subjects/strict/enrollment",
                    files=images(photo(1)),
                    data={"holder_key": key},
                ),
            ]
        for answer in answers:
            assert assert_error(answer, 422, "validation_failed") == {"field": "holder_key"}
            assert len(str(key)) < 20 or str(key)[:20] not in answer.text


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[Client, Client]]:
    """Two deployments that exchange exports."""
    key_file = tmp_path / "export.key"
    MasterKeyring.create(key_file)
    one, two = (
        deploy(tmp_path / name, export_key_file=key_file, lockout_after=0)
        for name in ("one", "two")
    )
    with (
        Client(create_app(one.settings), headers=bearer(one.token)) as first,
        Client(create_app(two.settings), headers=bearer(two.token)) as second,
    ):
        yield first, second


def test_an_import_needs_the_same_key(pair: tuple[Client, Client]) -> None:
    first, second = pair
    enroll(first, "moves")
    export = first.get("/v1/subjects/moves/export").json()["export"]
    answer = second.post("/v1/subjects/import", json={"export": export})
    assert assert_answer(answer, 201, ImportAnswer)["holder_key"] is True
    assert second.get("/v1/subjects/moves").json()["holder_key"] is True
    assert decided(second, "moves", KEY) == "accept"
    for key in (OTHER, None):
        assert decided(second, "moves", key) == "reject"
