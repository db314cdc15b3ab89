"""An attacker who reads and writes the database, keeps old copies of rows, and has no master key.

Each test does with plain SQL what such an attacker would, and asks the service over REST.
"""

import hashlib
import os
import uuid
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
import sqlalchemy as sa

from api.process.opening import open_keyring, open_store
from templates.errors import StoreError
from templates.keys.probe_signature import signed_probe
from templates.keys.sealing import MasterKeyring
from templates.store import By, TemplateStore
from templates.store.database import Database
from templates.store.record_check import (
    ACTOR_NEVER_CREATED,
    COUNT_ALTERED,
    COUNT_VANISHED,
    KEY_ALTERED,
    KEY_NEVER_CREATED,
    NONCE_TWICE,
    TENANT_ALTERED,
)
from templates.store.tenants import AlteredTenant
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.http.test_lockout import AFTER, attempt, enroll, fail
from tests.api.shapes import assert_error

TRIGGERS = (
    "audit_log_no_update",
    "audit_log_no_delete",
    "audit_log_no_replace",
    "audit_head_no_delete",
)
OPERATOR = By("operator:test")
ALL_RIGHTS = "admin,embeddings,enroll,erase,export,scores,verify"


class Attacker:
    """SQL on the service's database."""

    def __init__(self, url: str) -> None:
        self.database = Database(url)

    def run(self, *statements: str, **values: object) -> None:
        def work(connection: sa.Connection) -> None:
            for statement in statements:
                named = {name: values[name] for name in values if f":{name}" in statement}
                connection.execute(sa.text(statement), named)

        self.database.write(work)

    def rows(self, table: str, where: str = "1 = 1", **values: object) -> list[dict[str, Any]]:
        query = sa.text(f"SELECT * FROM {table} WHERE {where}")
        return self.database.read(
            lambda each: [row._asdict() for row in each.execute(query, values)]
        )

    def put_back(self, table: str, row: dict[str, Any], key: str) -> None:
        """Write a row as it was, whether it is still there or not."""
        self.run(f"DELETE FROM {table} WHERE {key} = :{key}", **row)
        self.insert(table, row)

    def insert(self, table: str, row: dict[str, Any]) -> None:
        columns, values = ", ".join(row), ", ".join(f":{name}" for name in row)
        self.run(f"INSERT INTO {table} ({columns}) VALUES ({values})", **row)

    def drop_triggers(self) -> None:
        if self.database.is_sqlite:
            self.run(*(f"DROP TRIGGER {name}" for name in TRIGGERS))
        else:
            self.run("ALTER TABLE audit_log DISABLE TRIGGER USER")


@pytest.fixture
def attacker(both: tuple[Client, Deployment]) -> Iterator[Attacker]:
    _, deployment = both
    attacker = Attacker(deployment.settings.resolved_database_url)
    yield attacker
    attacker.database.close()


@pytest.fixture
def store(both: tuple[Client, Deployment]) -> Iterator[TemplateStore]:
    _, deployment = both
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    yield store
    store.close()


def contract(client: Client, token: str) -> Any:
    """A call that any valid key may make."""
    return client.get("/v1/contract", headers=bearer(token))


def prefix_of(token: str) -> str:
    return token.split("_")[1]


def problems(store: TemplateStore) -> set[tuple[str, str]]:
    return {(problem.what, problem.about) for problem in store.check_records()}


# --- API keys ------------------------------------------------------------------------------


def test_a_made_up_key_is_none(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    client, _ = both
    tenant = attacker.rows("tenants")[0]["id"]
    token = f"vf_{os.urandom(6).hex()}_{os.urandom(32).hex()}"
    for line, mac in ((0, None), (0, os.urandom(32)), (10**6, os.urandom(32))):
        attacker.run(
            "DELETE FROM api_keys WHERE prefix = :prefix",
            "INSERT INTO api_keys (id, tenant_id, prefix, token_hash, rights, label, "
            "wrapped_probe_key, wrapping_key, created_at, line, mac) VALUES (:id, :tenant, "
            ":prefix, :token_hash, :rights, '', :zeros, '0123456789abcdef', :now, :line, :mac)",
            id=uuid.uuid4().hex,
            tenant=tenant,
            prefix=prefix_of(token),
            token_hash=hashlib.sha256(token.encode()).digest(),
            rights=ALL_RIGHTS,
            zeros=bytes(40),
            now=datetime.now(UTC).replace(tzinfo=None),
            line=line,
            mac=mac,
        )
        refused = contract(client, token)
        unknown = contract(client, f"vf_{os.urandom(6).hex()}_{os.urandom(32).hex()}")
        assert_error(refused, 401, "unauthorized")
        assert refused.json()["error"] == unknown.json()["error"]
    assert problems(store) == {(KEY_NEVER_CREATED, f"key:{prefix_of(token)}")}


def test_a_key_whose_hash_was_put_in_place_of_anothers_is_none(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    client, deployment = both
    prefix = prefix_of(deployment.token)
    token = f"vf_{prefix}_{os.urandom(32).hex()}"
    attacker.run(
        "UPDATE api_keys SET token_hash = :token_hash WHERE prefix = :prefix",
        token_hash=hashlib.sha256(token.encode()).digest(),
        prefix=prefix,
    )
    assert_error(contract(client, token), 401, "unauthorized")
    assert problems(store) == {(KEY_ALTERED, f"key:{prefix}")}


@pytest.mark.parametrize(
    "change",
    [
        "rights = 'admin,enroll,erase,export,verify'",
        "expires_at = NULL",
        "lowest_level = NULL",
        "tenant_id = (SELECT id FROM tenants WHERE name = 'other')",
        "mac = NULL",
    ],
)
def test_a_key_with_a_changed_column_is_none(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore, change: str
) -> None:
    client, _ = both
    store.tenants.create("other")
    made = store.api_keys.create(
        "default",
        ["verify"],
        expires_at=datetime.now(UTC) + timedelta(hours=1),
        lowest_level="fmr-1e-3",
    )
    assert contract(client, made.token).status_code == 200
    attacker.run(f"UPDATE api_keys SET {change} WHERE prefix = '{made.key.prefix}'")
    assert_error(contract(client, made.token), 401, "unauthorized")
    assert problems(store) == {(KEY_ALTERED, f"key:{made.key.prefix}")}


def test_a_revocation_is_not_undone(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    """Neither by emptying the column, nor by the row as it was, whose MAC is true."""
    client, deployment = both
    token = deployment.key("verify")
    (before,) = attacker.rows("api_keys", "prefix = :prefix", prefix=prefix_of(token))
    assert store.api_keys.revoke(prefix_of(token))
    (after,) = attacker.rows("api_keys", "prefix = :prefix", prefix=prefix_of(token))
    assert_error(contract(client, token), 401, "unauthorized")
    for row in ({**after, "revoked_at": None}, before, {**before, "line": after["line"]}):
        attacker.put_back("api_keys", row, "prefix")
        assert_error(contract(client, token), 401, "unauthorized")
        assert problems(store) == {(KEY_ALTERED, f"key:{prefix_of(token)}")}
    attacker.put_back("api_keys", after, "prefix")
    assert problems(store) == set()


def test_a_replaced_key_does_not_come_back(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    client, deployment = both
    token = deployment.key("verify")
    (before,) = attacker.rows("api_keys", "prefix = :prefix", prefix=prefix_of(token))
    new = store.api_keys.replace(prefix_of(token), grace=timedelta(0))
    assert new is not None
    attacker.put_back("api_keys", before, "prefix")
    assert_error(contract(client, token), 401, "unauthorized")
    assert contract(client, new.token).status_code == 200


def test_a_key_that_the_operator_revokes_is_not_vouched_for(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    """Revoking, and erasing a revocation afterwards, must not make an altered row a good one."""
    client, deployment = both
    token = deployment.key("verify")
    prefix = prefix_of(token)
    attacker.run(f"UPDATE api_keys SET rights = '{ALL_RIGHTS}' WHERE prefix = '{prefix}'")
    assert store.api_keys.replace(prefix, grace=timedelta(0)) is None
    assert store.api_keys.revoke(prefix)
    attacker.run(f"UPDATE api_keys SET revoked_at = NULL WHERE prefix = '{prefix}'")
    assert_error(contract(client, token), 401, "unauthorized")


def test_a_line_that_was_slipped_in_does_not_revive_a_key(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    client, deployment = both
    token = deployment.key("verify")
    (before,) = attacker.rows("api_keys", "prefix = :prefix", prefix=prefix_of(token))
    store.api_keys.revoke(prefix_of(token))
    copy = attacker.rows("audit_log", "action = 'key-create'")[-1]
    attacker.insert("audit_log", {**copy, "sequence": copy["sequence"] + 1000})
    attacker.put_back("api_keys", before, "prefix")
    assert_error(contract(client, token), 401, "unauthorized")


def test_an_actor_without_a_key_is_found(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    attacker.drop_triggers()
    client, deployment = both
    enroll(client)
    assert problems(store) == set()
    prefix = prefix_of(deployment.token)
    attacker.run(f"DELETE FROM audit_log WHERE detail = '{prefix}'")
    assert problems(store) == {
        (KEY_NEVER_CREATED, f"key:{prefix}"),
        (ACTOR_NEVER_CREATED, f"key:{prefix}"),
    }
    assert not store.audit_log.verify().intact


# --- tenants -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change", ["template_enrollment = true", "rotation_epoch = rotation_epoch + 1", "mac = NULL"]
)
def test_a_changed_tenant_enrolls_nobody(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore, change: str
) -> None:
    client, _ = both
    enroll(client)
    attacker.run(f"UPDATE tenants SET {change} WHERE name = 'default'")
    answer = client.put("/v1/subjects/bob/enrollment", files=images(photo(2), photo(2, 1)))
    assert_error(answer, 401, "unauthorized")
    assert problems(store) == {(TENANT_ALTERED, "default")}


def test_tenants_do_not_change_their_names(
    both: tuple[Client, Deployment], attacker: Attacker
) -> None:
    client, deployment = both
    token = deployment.key("verify", tenant="other")
    attacker.run(
        "UPDATE tenants SET name = 'x' WHERE name = 'default'",
        "UPDATE tenants SET name = 'default' WHERE name = 'other'",
        "UPDATE tenants SET name = 'other' WHERE name = 'x'",
    )
    for each in (token, deployment.token):
        assert_error(contract(client, each), 401, "unauthorized")


def test_a_setting_of_a_tenant_is_not_put_back(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    client, _ = both
    store.tenants.set_template_enrollment("default", True)
    (before,) = attacker.rows("tenants", "name = 'default'")
    store.tenants.set_template_enrollment("default", False)
    enroll(client)
    names = ("template_enrollment", "line", "mac")
    changes = ", ".join(f"{name} = :{name}" for name in names)
    attacker.run(
        f"UPDATE tenants SET {changes} WHERE name = 'default'",
        **{name: before[name] for name in names},
    )
    with pytest.raises(AlteredTenant):
        store.tenants.get("default")
    assert problems(store) == {(TENANT_ALTERED, "default")}


# --- locks ---------------------------------------------------------------------------------

LIFTS = {
    "removed": "DELETE FROM failed_attempts",
    "emptied": "UPDATE failed_attempts SET consecutive = 0, locked_until = NULL",
    "ended": "UPDATE failed_attempts SET locked_until = '2020-01-01 00:00:00'",
    "stripped": "UPDATE failed_attempts SET mac = NULL",
    "of another": "UPDATE failed_attempts SET pseudonym = '" + "0" * 64 + "'",
}


@pytest.mark.parametrize("subject", ["alice", "nobody"])
@pytest.mark.parametrize("lift", LIFTS)
def test_a_lock_is_not_lifted(
    both: tuple[Client, Deployment],
    attacker: Attacker,
    store: TemplateStore,
    lift: str,
    subject: str,
) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    fail(client, token, AFTER, subject)
    assert problems(store) == set()
    attacker.run(LIFTS[lift])
    found = {what for what, _ in problems(store)}
    assert found <= {COUNT_ALTERED, COUNT_VANISHED}
    assert found
    answer = attempt(client, token, 1, subject)
    assert assert_error(answer, 423, "locked_out") == {"disabled": False}
    assert 1 <= int(answer.headers["retry-after"]) <= 30
    status = store.attempts.status("default", subject)
    assert status is not None
    assert status.consecutive == AFTER


def test_a_count_is_not_put_back(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    """Whoever writes the row of one failure back after each further one would guess for ever."""
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    fail(client, token, 1)
    (one,) = attacker.rows("failed_attempts")
    for _ in range(AFTER - 1):
        fail(client, token, 1)
        attacker.put_back("failed_attempts", one, "pseudonym")
    assert (COUNT_VANISHED, one["pseudonym"]) in problems(store)
    assert_error(attempt(client, token, 1), 423, "locked_out")


def test_lines_that_were_slipped_in_lift_no_lock(
    both: tuple[Client, Deployment], attacker: Attacker
) -> None:
    """An accept of one's own, copied behind the head."""
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    assert attempt(client, token, 1).json()["decision"] == "accept"
    (accept,) = attacker.rows("audit_log", "outcome = 'accept'")
    fail(client, token, AFTER)
    attacker.run("DELETE FROM failed_attempts")
    attacker.insert("audit_log", {**accept, "sequence": 10**6})
    assert_error(attempt(client, token, 1), 423, "locked_out")


def test_a_time_that_is_none_is_no_defect(both: tuple[Client, Deployment]) -> None:
    """SQLite keeps any text where a time should be."""
    client, deployment = both
    attacker = Attacker(deployment.settings.resolved_database_url)
    if not attacker.database.is_sqlite:
        pytest.skip("PostgreSQL keeps times only")
    token = deployment.key("verify")
    fail(client, token, 1)
    attacker.run("UPDATE failed_attempts SET locked_until = 'never'")
    assert_error(attempt(client, token, 1), 503, "store_unavailable")
    with pytest.raises(StoreError, match="failed_attempts"):
        client.app.state.runtime.store.check_records()
    attacker.run(f"UPDATE api_keys SET expires_at = 'never' WHERE prefix = '{prefix_of(token)}'")
    assert_error(contract(client, token), 401, "unauthorized")
    attacker.database.close()


def test_a_made_up_lock_locks_nobody_out(
    both: tuple[Client, Deployment], attacker: Attacker
) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    fail(client, token, AFTER - 1)
    attacker.run("UPDATE failed_attempts SET consecutive = 50, disabled_at = last_failed_at")
    assert attempt(client, token, 1).json()["decision"] == "accept"
    attacker.run("UPDATE failed_attempts SET consecutive = 50, disabled_at = last_failed_at")
    assert attempt(client, token, 1).json()["decision"] == "accept"


def test_an_operator_lifts_a_lock_whose_row_is_gone(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    fail(client, token, AFTER)
    attacker.run("DELETE FROM failed_attempts")
    assert store.attempts.reset("default", "alice", by=OPERATOR)
    assert attempt(client, token, 1).json()["decision"] == "accept"
    assert not store.attempts.reset("default", "alice", by=OPERATOR)


def test_the_locks_of_an_erased_subject_and_tenant_are_gone(
    both: tuple[Client, Deployment], store: TemplateStore
) -> None:
    """What removes a count rightly does not leave one in the log."""
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    fail(client, token, AFTER)
    store.erasures.erase("default", "alice")
    assert store.attempts.status("default", "alice") is None
    other = deployment.key("verify", tenant="other")
    fail(client, other, AFTER, "bob")
    store.tenant_erasures.erase("other")
    assert problems(store) == set()
    again = deployment.key("verify", tenant="other")
    fail(client, again, 1, "bob")
    status = store.attempts.status("other", "bob")
    assert status is not None
    assert (status.consecutive, status.total) == (1, 1)


# --- nonces --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "forget",
    ["DELETE FROM used_nonces", "UPDATE used_nonces SET expires_at = '2020-01-01 00:00:00'"],
)
def test_a_signed_probe_does_not_pass_twice(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore, forget: str
) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify", "embeddings")
    face = client.app.state.runtime.pack.embed_photo(photo(1, 5)).embedding
    body = signed_probe(token, "alice", face)

    def send() -> Any:
        return client.post(
            "/v1/subjects/alice/verify", json=body, headers=bearer(token), sign=False
        )

    assert send().json()["decision"] == "accept"
    attacker.run(forget)
    store.purge()
    assert_error(send(), 401, "replayed")
    assert problems(store) == set()


def test_a_nonce_that_served_twice_is_found(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    """With the lines of the first decision set aside, and put back afterwards."""
    client, deployment = both
    enroll(client)
    token = deployment.key("verify", "embeddings")
    face = client.app.state.runtime.pack.embed_photo(photo(1, 5)).embedding
    body = signed_probe(token, "alice", face)
    path = "/v1/subjects/alice/verify"
    assert client.post(path, json=body, headers=bearer(token), sign=False).status_code == 200
    attacker.drop_triggers()
    line = attacker.rows("audit_log", "nonce IS NOT NULL")[0]
    attacker.run(
        "DELETE FROM used_nonces",
        "DELETE FROM audit_log WHERE sequence = :sequence",
        sequence=line["sequence"],
    )
    assert client.post(path, json=body, headers=bearer(token), sign=False).status_code == 200
    assert not store.audit_log.verify().intact
    attacker.insert("audit_log", line)
    assert store.audit_log.verify().intact
    assert problems(store) == {(NONCE_TWICE, f"line {store.audit_log.head().sequence}")}


# --- answers -------------------------------------------------------------------------------


def test_a_made_up_answer_is_not_given(both: tuple[Client, Deployment], attacker: Attacker) -> None:
    client, _ = both
    headers = {"Idempotency-Key": "once"}

    def enroll_once() -> Any:
        return client.put(
            "/v1/subjects/alice/enrollment", files=images(photo(1), photo(1, 1)), headers=headers
        )

    first, again = enroll_once(), enroll_once()
    assert again.json()["template_id"] == first.json()["template_id"]
    attacker.run("UPDATE idempotency SET body = :body", body=b'{"template_id": "mine"}')
    mended = enroll_once()
    assert mended.status_code == 200
    assert mended.json()["template_id"] not in ("mine", first.json()["template_id"])
    assert enroll_once().json()["template_id"] == mended.json()["template_id"]


# --- the upgrade, and what must still work ---------------------------------------------------


def test_stripping_macs_does_not_make_the_next_start_renew_them(
    both: tuple[Client, Deployment], attacker: Attacker, store: TemplateStore
) -> None:
    client, deployment = both
    token = deployment.key("verify")
    prefix = prefix_of(token)
    attacker.run(
        f"UPDATE api_keys SET rights = '{ALL_RIGHTS}' WHERE prefix = '{prefix}'",
        "UPDATE api_keys SET mac = NULL, line = 0",
        "UPDATE tenants SET mac = NULL, line = 0",
    )
    assert store.upgrade().rows == 0
    for each in (token, deployment.token):
        assert_error(contract(client, each), 401, "unauthorized")


def test_all_still_works_after_the_master_key_is_rotated(
    both: tuple[Client, Deployment], store: TemplateStore
) -> None:
    client, deployment = both
    enroll(client)
    token = deployment.key("verify")
    fail(client, token, 2)
    path = deployment.settings.resolved_master_key_file
    MasterKeyring.add_current(path)
    store.wrapped_keys.rewrap()
    MasterKeyring.drop_retired(path, keep=MasterKeyring.load(path).current)
    assert attempt(client, token, 1).json()["decision"] == "accept"
    fresh = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        fresh.upgrade()
        assert fresh.api_keys.verify(token) is not None
        assert fresh.tenants.get("default").rotation_epoch == 1
        fresh.rerotation.begin("default")
        assert fresh.rerotation.move("default") == 1
        fresh.rerotation.retire("default")
        assert fresh.check_records() == ()
    finally:
        fresh.close()
    assert attempt(client, token, 1).json()["decision"] == "accept"


@pytest.fixture
def warned(caplog: pytest.LogCaptureFixture) -> Callable[[], list[Any]]:
    return lambda: [record for record in caplog.records if record.name == "veilface.store"]


def test_the_operator_is_warned_without_a_secret(
    both: tuple[Client, Deployment], attacker: Attacker, warned: Callable[[], list[Any]]
) -> None:
    client, deployment = both
    token = deployment.key("verify")
    fail(client, token, 1, "alice")
    attacker.run("DELETE FROM failed_attempts")
    fail(client, token, 1, "alice")
    attacker.run("UPDATE api_keys SET mac = NULL")
    assert_error(contract(client, token), 401, "unauthorized")
    texts = [f"{record.getMessage()} {record.fields}" for record in warned()]
    assert any("failed attempts" in text for text in texts)
    assert any(prefix_of(token) in text for text in texts)
    assert not any("alice" in text or token in text for text in texts)
