import contextlib
import json
import sqlite3
from pathlib import Path

import pytest

from api.http.app import create_app
from api.http.receipts import read_receipt_key, verify_answer
from api.http.schemas import ReceiptAnswer, SubjectAnswer, SubjectsAnswer
from templates.errors import StoreError
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.shapes import assert_answer, assert_error


def enroll(client: Client, subject: str, person: int = 1) -> None:
    answer = client.put(f"/v1/subjects/{subject}/enrollment", files=images(photo(person)))
    assert answer.status_code in (200, 201)


def test_pages_hold_every_subject_once(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    names = [f"person-{i}" for i in range(7)] + ["A", "b@x.org", "_", "z:1"]
    for name in names:
        enroll(client, name)
    seen, cursor = [], None
    while True:
        params = {"limit": 3} | ({} if cursor is None else {"cursor": cursor})
        page = assert_answer(client.get("/v1/subjects", params=params), 200, SubjectsAnswer)
        seen += [entry["subject_id"] for entry in page["subjects"]]
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert seen == sorted(names)
    found = assert_answer(client.get("/v1/subjects?prefix=b%40"), 200, SubjectsAnswer)
    assert [entry["subject_id"] for entry in found["subjects"]] == ["b@x.org"]
    for bad in ("%00", "a%2Fb", "a" * 129):
        assert_error(client.get(f"/v1/subjects?prefix={bad}"), 422, "validation_failed")


def test_a_description_has_no_template(client: Client, deployment: Deployment) -> None:
    enroll(client, "described")
    body = assert_answer(client.get("/v1/subjects/described"), 200, SubjectAnswer)
    assert body["contract_id"] == deployment.contract.contract_id
    assert body["current"] is True
    assert (body["enrolled_by"], body["photos"]) == ("photos", 1)
    assert len(json.dumps(body)) < 600


def test_an_erasure_says_that_a_reader_keeps_old_pages(
    client: Client, deployment: Deployment, capfd: pytest.CaptureFixture[str]
) -> None:
    enroll(client, "read")
    with contextlib.closing(sqlite3.connect(deployment.settings.data_dir / "veilface.db")) as idle:
        idle.execute("BEGIN")
        idle.execute("SELECT count(*) FROM subjects").fetchone()
        answer = assert_answer(client.delete("/v1/subjects/read"), 200, ReceiptAnswer)
        assert answer["log_purged"] is False
    assert '"log_purged": false' in capfd.readouterr().err
    again = assert_answer(client.delete("/v1/subjects/read"), 200, ReceiptAnswer)
    assert again["log_purged"] is True


def test_a_database_that_was_removed_is_not_ready(tmp_path: Path) -> None:
    own = deploy(tmp_path)
    database = own.settings.data_dir / "veilface.db"
    with Client(create_app(own.settings), headers=bearer(own.token)) as client:
        database.rename(database.with_suffix(".aside"))
        answer = client.put("/v1/subjects/lost/enrollment", files=images(photo(1)))
        assert_error(answer, 503, "store_unavailable")
        assert_error(client.get("/health/ready"), 503, "store_unavailable")
        database.with_suffix(".aside").rename(database)
        assert client.get("/health/ready").status_code == 200
        enroll(client, "kept")


def test_erasing_leaves_a_receipt_that_verifies(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    key = client.get("/v1/contract").json()["receipt_key"]
    enroll(client, "gone")
    first = assert_answer(client.delete("/v1/subjects/gone"), 200, ReceiptAnswer)
    claims = verify_answer(first, read_receipt_key(key))
    assert claims == first["claims"]
    assert claims["held"] is True
    assert claims["signing_key"] == key["key_id"]
    assert claims["contract_id"] == deployment.contract.contract_id
    counts = {entry["item"]: entry["count"] for entry in claims["erased"]}
    assert (counts["template"], counts["data_key"], counts["metadata"]) == (1, 1, 1)
    assert "gone" not in json.dumps(first)
    assert_error(client.get("/v1/subjects/gone"), 404, "not_enrolled")
    probe = client.post(
        "/v1/subjects/gone/verify",
        files=images(photo(1), name="image"),
        headers=bearer(deployment.key("verify")),
    )
    assert probe.json()["decision"] == "reject"
    again = client.delete("/v1/subjects/gone").json()
    assert again["receipt"] == first["receipt"]
    tampered = json.loads(json.dumps(first))
    tampered["receipt"]["body"] = tampered["receipt"]["body"].replace("true", "false")
    for broken in (tampered, {}, {"receipt": 5}, {"receipt": {"body": "x", "signature": "!"}}):
        with pytest.raises(StoreError):
            verify_answer(broken, read_receipt_key(key))


def test_erasing_who_never_was(client: Client, deployment: Deployment) -> None:
    assert_error(client.delete("/v1/subjects/never"), 404, "not_enrolled")
    blind = bearer(deployment.key("erase"))
    answer = assert_answer(client.delete("/v1/subjects/never", headers=blind), 200, ReceiptAnswer)
    assert answer["claims"]["held"] is False


def test_erased_and_enrolled_again_gets_another_receipt(client: Client) -> None:
    receipts = []
    for _ in range(2):
        enroll(client, "returns")
        receipts.append(client.delete("/v1/subjects/returns").json()["receipt"])
    assert receipts[0] != receipts[1]


def test_tenants_do_not_see_each_other(client: Client, deployment: Deployment) -> None:
    rights = ("enroll", "verify", "erase", "export", "embeddings", "scores", "admin")
    other = bearer(deployment.key(*rights, tenant="other"))
    enroll(client, "mine")
    assert_error(client.get("/v1/subjects/mine", headers=other), 404, "not_enrolled")
    assert client.get("/v1/subjects", headers=other).json()["subjects"] == []
    assert_error(client.delete("/v1/subjects/mine", headers=other), 404, "not_enrolled")
    assert_error(client.get("/v1/subjects/mine/export", headers=other), 404, "not_enrolled")
    probe = client.post(
        "/v1/subjects/mine/verify", files=images(photo(1), name="image"), headers=other
    )
    assert_error(probe, 404, "not_enrolled")
    put = client.put("/v1/subjects/mine/enrollment", files=images(photo(2)), headers=other)
    assert put.status_code == 201
    own = client.post("/v1/subjects/mine/verify", files=images(photo(1), name="image"))
    assert own.json()["decision"] == "accept"
    cursor = client.get("/v1/subjects?limit=1").json()["next_cursor"]
    if cursor is not None:
        stolen = client.get("/v1/subjects", params={"cursor": cursor}, headers=other)
        assert_error(stolen, 422, "validation_failed")


def test_a_subject_id_of_any_script_has_one_spelling(client: Client) -> None:
    """Of NFC: by path, by token, in a query and in answers; what nobody sees is refused."""
    composed, apart = "Zo\xeb_\u0928\u0947\u0939\u093e", "Zoe\u0308_\u0928\u0947\u0939\u093e"
    first = client.put(f"/v1/subjects/{apart}/enrollment", files=images(photo(1)))
    assert (first.status_code, first.json()["replaced"]) == (201, False)
    for spelled in (composed, apart):
        assert client.get(f"/v1/subjects/{spelled}").json()["subject_id"] == composed
        listed = client.get("/v1/subjects", params={"prefix": spelled}).json()["subjects"]
        assert [each["subject_id"] for each in listed] == [composed]
        lines = client.get("/v1/audit-log", params={"subject_id": spelled}).json()["lines"]
        assert lines[-1]["action"] == "enroll"
    asked = {"subject_id": apart, "action": "verify"}
    token = client.post("/v1/tokens", json=asked).json()
    assert token["subject_id"] == composed
    answer = client.post(
        f"/v1/subjects/{apart}/verify",
        files=images(photo(1, 2), name="image"),
        headers=bearer(token["token"]),
    )
    assert answer.json()["decision"] == "accept"
    assert client.delete(f"/v1/subjects/{apart}").json()["claims"]["held"]
    for refused in ("Zo\xeb\u200b", "Zo\xeb\u202e", "a\u00a0b", "\U0001f600", "%ff"):
        assert_error(client.get(f"/v1/subjects/{refused}"), 422, "validation_failed")
        asked = {"subject_id": refused, "action": "verify"}
        assert_error(client.post("/v1/tokens", json=asked), 422, "validation_failed")
