"""An attacker who reads and writes the database, keeps old rows, and has no master key.

Each case does with plain SQL what such an attacker would, and asks the service over REST. What
makes a right, an enrollment or a receipt is refused. What puts an earlier row back is taken, and
``veilface audit-log verify`` reports it. The store's own test has each column.
"""

import base64
import hashlib
import os
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import pytest
import sqlalchemy as sa

from api.service.opening import open_keyring, open_store
from templates.errors import StoreError
from templates.store import TemplateStore
from templates.store.database import Database
from templates.store.evidence import COUNT_LIFTED, KEY_ALTERED, KEY_PUT_BACK
from templates.store.receipts import Receipt, verify_receipt
from tests.api.calls import AFTER, attempt, enroll, fail
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer
from tests.api.shapes import assert_error


@dataclass(frozen=True)
class Attacked:
    """The service, the store as its operator opens it, and the attacker's database."""

    client: Client
    deployment: Deployment
    store: TemplateStore
    database: Database

    def run(self, statement: str, **values: object) -> None:
        self.database.write(lambda connection: connection.execute(sa.text(statement), values))

    def rows(self, table: str, where: str = "1 = 1") -> list[dict[str, Any]]:
        query = sa.text(f"SELECT * FROM {table} WHERE {where}")
        return self.database.read(
            lambda connection: [row._asdict() for row in connection.execute(query)]
        )

    def insert(self, table: str, row: dict[str, Any]) -> None:
        columns, values = ", ".join(row), ", ".join(f":{name}" for name in row)
        self.run(f"INSERT INTO {table} ({columns}) VALUES ({values})", **row)

    def put_back(self, table: str, rows: list[dict[str, Any]]) -> None:
        self.run(f"DELETE FROM {table}")
        for row in rows:
            self.insert(table, row)

    def accepts(self, token: str) -> bool:
        """Whether the service knows a token; else it must say no more than that it does not."""
        answer = self.client.get("/v1/contract", headers=bearer(token))
        if answer.status_code != 200:
            assert_error(answer, 401, "unauthorized")
            unknown = self.client.get("/v1/contract", headers=bearer(new_token()))
            assert answer.json()["error"] == unknown.json()["error"]
        return bool(answer.status_code == 200)

    def reported(self) -> set[str]:
        """What `audit-log verify` names."""
        walk, records = self.store.verify_audit_log()
        told = {record.what for record in records}
        return told if walk.problem is None else {walk.problem.what, *told}


@pytest.fixture
def attacked(both: tuple[Client, Deployment]) -> Iterator[Attacked]:
    client, deployment = both
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    database = Database(deployment.settings.resolved_database_url)
    yield Attacked(client, deployment, store, database)
    database.close()
    store.close()


def prefix_of(token: str) -> str:
    return token.split("_")[1]


def new_token(prefix: str | None = None) -> str:
    return f"vf_{prefix or os.urandom(6).hex()}_{os.urandom(32).hex()}"


def hash_of(token: str) -> bytes:
    return hashlib.sha256(token.encode()).digest()


# --- refused -------------------------------------------------------------------------------


def test_a_minted_key_is_refused(attacked: Attacked) -> None:
    token = new_token()
    (own,) = attacked.rows("api_keys")
    row = {**own, "id": uuid.uuid4().hex, "prefix": prefix_of(token), "token_hash": hash_of(token)}
    attacked.insert("api_keys", row)
    assert not attacked.accepts(token)
    assert attacked.reported() == {KEY_ALTERED}


WIDENED = {
    "rights": "UPDATE api_keys SET rights = 'admin,enroll,verify' WHERE prefix = :prefix",
    "token": "UPDATE api_keys SET token_hash = :token_hash WHERE prefix = :prefix",
}


@pytest.mark.parametrize("how", WIDENED)
def test_a_widened_key_is_refused(attacked: Attacked, how: str) -> None:
    new = attacked.store.api_keys.create("default", ["verify"])
    assert attacked.accepts(new.token)
    token = new_token(new.key.prefix) if how == "token" else new.token
    values = {"prefix": new.key.prefix, "token_hash": hash_of(token)}
    named = {name: values[name] for name in values if f":{name}" in WIDENED[how]}
    attacked.run(WIDENED[how], **named)
    assert not attacked.accepts(token)
    assert attacked.reported() == {KEY_ALTERED}
    # And nothing that its operator does with it vouches for it.
    assert attacked.store.api_keys.replace(new.key.prefix, grace=timedelta(0)) is None
    attacked.store.api_keys.revoke(new.key.prefix)
    attacked.run("UPDATE api_keys SET revoked_at = NULL")
    assert not attacked.accepts(token)


FORGED = {
    "the subject's name": (
        "UPDATE subjects SET subject_id = 'alice' WHERE subject_id = 'mallory'",
    ),
    "the template": (
        "UPDATE templates SET ciphertext = (SELECT ciphertext FROM templates JOIN subjects "
        "ON subject_pk = subjects.id WHERE subject_id = 'mallory')",
        "UPDATE templates SET template_id = (SELECT template_id FROM templates JOIN subjects "
        "ON subject_pk = subjects.id WHERE subject_id = 'mallory')",
        "UPDATE subjects SET wrapped_key = (SELECT wrapped_key FROM subjects "
        "WHERE subject_id = 'mallory')",
    ),
}


@pytest.mark.parametrize("how", FORGED)
def test_a_forged_enrollment_is_refused(attacked: Attacked, how: str) -> None:
    """Mallory, who is enrolled, wants to be accepted as Alice."""
    enroll(attacked.client, "mallory", 3)
    enroll(attacked.client, "alice", 1)
    if how == "the subject's name":
        attacked.run("UPDATE subjects SET subject_id = 'away' WHERE subject_id = 'alice'")
    for statement in FORGED[how]:
        attacked.run(statement)
    token = attacked.deployment.key("verify")
    assert_error(attempt(attacked.client, token, 3), 503, "store_unavailable")


@pytest.mark.parametrize(
    "change", ["pseudonym = :other", "body = replace(body, :pseudonym, :other), pseudonym = :other"]
)
def test_a_forged_receipt_does_not_verify(attacked: Attacked, change: str) -> None:
    """Of an erasure that never was, made of the receipt of another one."""
    erasing = {"headers": bearer(attacked.deployment.key("erase"))}
    erased = attacked.client.delete("/v1/subjects/alice", **erasing).json()["receipt"]
    signer = attacked.store.signer
    alice, bob = (signer.pseudonym("default", name) for name in ("alice", "bob"))
    values = {"other": bob, **({"pseudonym": alice} if ":pseudonym" in change else {})}
    attacked.run(f"UPDATE receipts SET {change}", **values)
    told = attacked.client.delete("/v1/subjects/bob", **erasing).json()["receipt"]
    contract = attacked.client.get("/v1/contract").json()
    key = base64.b64decode(contract["receipt_key"]["public_key"])
    assert verify_receipt(Receipt.from_json(erased), key)["subject"] == alice
    if change.startswith("body"):
        with pytest.raises(StoreError, match="signature"):
            verify_receipt(Receipt.from_json(told), key)
    else:
        assert verify_receipt(Receipt.from_json(told), key)["subject"] != bob


# --- taken, and reported -------------------------------------------------------------------


def undo_revocation(attacked: Attacked) -> str:
    token = attacked.deployment.key("verify")
    rows = attacked.rows("api_keys")
    assert attacked.store.api_keys.revoke(prefix_of(token))
    assert not attacked.accepts(token)
    attacked.put_back("api_keys", rows)
    assert attacked.accepts(token)
    return KEY_PUT_BACK


def undo_replacement(attacked: Attacked) -> str:
    token = attacked.deployment.key("verify")
    rows = attacked.rows("api_keys")
    assert attacked.store.api_keys.replace(prefix_of(token), grace=timedelta(0))
    assert not attacked.accepts(token)
    attacked.put_back("api_keys", rows)
    assert attacked.accepts(token)
    return KEY_PUT_BACK


END_LOCK = "UPDATE failed_attempts SET consecutive = 0"


def lift(statement: str, face: int) -> Callable[[Attacked], str]:
    def attack(attacked: Attacked) -> str:
        enroll(attacked.client)
        token = attacked.deployment.key("verify")
        fail(attacked.client, token, AFTER)
        assert_error(attempt(attacked.client, token, face), 423, "locked_out")
        attacked.run(statement)
        assert attempt(attacked.client, token, face).status_code == 200
        return COUNT_LIFTED

    return attack


def refuse_after_lift(attacked: Attacked) -> str:
    """The line of a refused call, which the attacker may make, does not hide it."""
    told = lift(END_LOCK, 2)(attacked)
    token = attacked.deployment.key("verify")
    path = "/v1/subjects/alice/verify"
    assert attacked.client.post(path, json={}, headers=bearer(token)).status_code == 422
    assert attacked.client.delete("/v1/subjects/alice", headers=bearer(token)).status_code == 403
    return told


def cut(statement: str, what: str) -> Callable[[Attacked], str]:
    def attack(attacked: Attacked) -> str:
        enroll(attacked.client)
        attempt(attacked.client, attacked.deployment.key("verify"), 2)
        attacked.run(statement)
        return what

    return attack


def use_token_again(attacked: Attacked) -> str:
    enroll(attacked.client)
    asked = {"subject_id": "alice", "action": "verify"}
    token = attacked.client.post("/v1/tokens", json=asked).json()["token"]
    assert attempt(attacked.client, token, 1).status_code == 200
    assert_error(attempt(attacked.client, token, 1), 401, "replayed")
    attacked.run("UPDATE audit_log SET token = NULL")
    assert attempt(attacked.client, token, 1).status_code == 200
    return "altered"


LAST = "(SELECT max(sequence) FROM audit_log)"
REPORTED = {
    "a revocation undone": undo_revocation,
    "a replacement undone": undo_replacement,
    "a lock lifted": lift("DELETE FROM failed_attempts", 2),
    "a lock lifted, and passed": lift("DELETE FROM failed_attempts", 1),
    "a lock ended": lift(END_LOCK, 2),
    "a lock lifted, and a call refused": refuse_after_lift,
    "the end cut off": cut(f"DELETE FROM audit_log WHERE sequence = {LAST}", "missing"),
    "a line cut out": cut("DELETE FROM audit_log WHERE sequence = 2", "missing"),
    "a line altered": cut("UPDATE audit_log SET outcome = 'accept'", "altered"),
    "a token used twice": use_token_again,
}


@pytest.mark.parametrize("attack", REPORTED)
def test_what_is_put_back_is_reported(attacked: Attacked, attack: str) -> None:
    assert attacked.reported() == set()
    told = REPORTED[attack](attacked)
    assert told in attacked.reported()


def test_a_made_up_key_is_warned_of_without_a_secret(
    attacked: Attacked, caplog: pytest.LogCaptureFixture
) -> None:
    token = attacked.deployment.key("verify")
    attacked.run("UPDATE api_keys SET rights = 'admin'")
    assert not attacked.accepts(token)
    records: list[Any] = [record for record in caplog.records if record.name == "veilface.store"]
    assert any(record.fields == {"key_id": prefix_of(token)} for record in records)
    assert not any(token in f"{record.getMessage()} {record.fields}" for record in records)
