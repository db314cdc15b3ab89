"""An attacker who reads and writes the database, keeps old copies of rows, and has no master key.

Each test does with plain SQL what such an attacker would, and asks the service over REST.
"""

import hashlib
import os
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
import sqlalchemy as sa

from api.http.schemas import AuditLogAnswer
from api.process.opening import open_keyring, open_store
from templates.errors import StoreError
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
from tests.api.shapes import assert_answer, assert_error

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
            lambda connection: [row._asdict() for row in connection.execute(query, values)]
        )

    def row(self, table: str, where: str, **values: object) -> dict[str, Any]:
        (row,) = self.rows(table, where, **values)
        return row

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


@dataclass(frozen=True)
class Attacked:
    """The service, the store as its operator opens it, and the attacker."""

    client: Client
    deployment: Deployment
    store: TemplateStore
    attacker: Attacker

    def accepts(self, token: str) -> bool:
        """Whether the service knows a token; else it must say no more than that it does not."""
        answer = self.client.get("/v1/contract", headers=bearer(token))
        if answer.status_code != 200:
            assert_error(answer, 401, "unauthorized")
            unknown = self.client.get("/v1/contract", headers=bearer(new_token()))
            assert answer.json()["error"] == unknown.json()["error"]
        return bool(answer.status_code == 200)

    def key_row(self, token: str) -> dict[str, Any]:
        return self.attacker.row("api_keys", "prefix = :prefix", prefix=prefix_of(token))

    def problems(self) -> set[tuple[str, str]]:
        return {(problem.what, problem.about) for problem in self.store.check_records()}

    def locked(self, failures: int = AFTER, subject: str = "alice") -> str:
        """Enroll alice and fail on a subject; returns the token of the key that failed."""
        enroll(self.client)
        token = self.deployment.key("verify")
        fail(self.client, token, failures, subject)
        return token

    def decides(self, token: str, subject: str = "alice") -> Any:
        """Answer to alice's own face."""
        return attempt(self.client, token, 1, subject)

    def one_use(self) -> Callable[[], Any]:
        """Send alice's face with one and the same token, as often as it is called."""
        asked = {"subject_id": "alice", "action": "verify"}
        token = self.client.post("/v1/tokens", json=asked).json()["token"]
        return lambda: self.decides(token)


@pytest.fixture
def attacked(both: tuple[Client, Deployment]) -> Iterator[Attacked]:
    client, deployment = both
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    attacker = Attacker(deployment.settings.resolved_database_url)
    yield Attacked(client, deployment, store, attacker)
    attacker.database.close()
    store.close()


def prefix_of(token: str) -> str:
    return token.split("_")[1]


def new_token(prefix: str | None = None) -> str:
    return f"vf_{prefix or os.urandom(6).hex()}_{os.urandom(32).hex()}"


# --- API keys ------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [0, 10**6])
@pytest.mark.parametrize("mac", [None, bytes(range(32))])
def test_a_made_up_key_is_none(attacked: Attacked, line: int, mac: bytes | None) -> None:
    token = new_token()
    own = attacked.key_row(attacked.deployment.token)
    changed = {
        "id": uuid.uuid4().hex,
        "prefix": prefix_of(token),
        "token_hash": hashlib.sha256(token.encode()).digest(),
        "line": line,
        "mac": mac,
    }
    attacked.attacker.insert("api_keys", {**own, **changed})
    assert not attacked.accepts(token)
    assert attacked.problems() == {(KEY_NEVER_CREATED, f"key:{prefix_of(token)}")}


def test_a_key_whose_hash_was_put_in_place_of_anothers_is_none(attacked: Attacked) -> None:
    prefix = prefix_of(attacked.deployment.token)
    token = new_token(prefix)
    attacked.attacker.run(
        "UPDATE api_keys SET token_hash = :token_hash WHERE prefix = :prefix",
        token_hash=hashlib.sha256(token.encode()).digest(),
        prefix=prefix,
    )
    assert not attacked.accepts(token)
    assert attacked.problems() == {(KEY_ALTERED, f"key:{prefix}")}


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
def test_a_key_with_a_changed_column_is_none(attacked: Attacked, change: str) -> None:
    attacked.store.tenants.create("other")
    new = attacked.store.api_keys.create(
        "default",
        ["verify"],
        expires_at=datetime.now(UTC) + timedelta(hours=1),
        lowest_level="fmr-1e-3",
    )
    assert attacked.accepts(new.token)
    attacked.attacker.run(f"UPDATE api_keys SET {change} WHERE prefix = '{new.key.prefix}'")
    assert not attacked.accepts(new.token)
    assert attacked.problems() == {(KEY_ALTERED, f"key:{new.key.prefix}")}


def test_a_revocation_is_not_undone(attacked: Attacked) -> None:
    """Neither by emptying the column, nor by the row as it was, whose MAC is true."""
    token = attacked.deployment.key("verify")
    before = attacked.key_row(token)
    assert attacked.store.api_keys.revoke(prefix_of(token))
    after = attacked.key_row(token)
    assert not attacked.accepts(token)
    for row in ({**after, "revoked_at": None}, before, {**before, "line": after["line"]}):
        attacked.attacker.put_back("api_keys", row, "prefix")
        assert not attacked.accepts(token)
        assert attacked.problems() == {(KEY_ALTERED, f"key:{prefix_of(token)}")}
    attacked.attacker.put_back("api_keys", after, "prefix")
    assert attacked.problems() == set()


def test_a_replaced_key_does_not_come_back(attacked: Attacked) -> None:
    token = attacked.deployment.key("verify")
    before = attacked.key_row(token)
    new = attacked.store.api_keys.replace(prefix_of(token), grace=timedelta(0))
    assert new is not None
    attacked.attacker.put_back("api_keys", before, "prefix")
    assert not attacked.accepts(token)
    assert attacked.accepts(new.token)


def test_a_key_that_the_operator_revokes_is_not_vouched_for(attacked: Attacked) -> None:
    """Revoking, and erasing a revocation afterwards, must not make an altered row a good one."""
    token = attacked.deployment.key("verify")
    prefix = prefix_of(token)
    attacked.attacker.run(f"UPDATE api_keys SET rights = '{ALL_RIGHTS}' WHERE prefix = '{prefix}'")
    assert attacked.store.api_keys.replace(prefix, grace=timedelta(0)) is None
    assert attacked.store.api_keys.revoke(prefix)
    attacked.attacker.run(f"UPDATE api_keys SET revoked_at = NULL WHERE prefix = '{prefix}'")
    assert not attacked.accepts(token)


def test_a_line_that_was_slipped_in_does_not_revive_a_key(attacked: Attacked) -> None:
    token = attacked.deployment.key("verify")
    before = attacked.key_row(token)
    attacked.store.api_keys.revoke(prefix_of(token))
    line = attacked.attacker.rows("audit_log", "action = 'key-create'")[-1]
    attacked.attacker.insert("audit_log", {**line, "sequence": line["sequence"] + 1000})
    attacked.attacker.put_back("api_keys", before, "prefix")
    assert not attacked.accepts(token)


def test_an_actor_without_a_key_is_found(attacked: Attacked) -> None:
    attacked.attacker.drop_triggers()
    enroll(attacked.client)
    assert attacked.problems() == set()
    prefix = prefix_of(attacked.deployment.token)
    attacked.attacker.run(f"DELETE FROM audit_log WHERE detail = '{prefix}'")
    assert attacked.problems() == {
        (KEY_NEVER_CREATED, f"key:{prefix}"),
        (ACTOR_NEVER_CREATED, f"key:{prefix}"),
    }
    assert not attacked.store.audit_log.verify().intact


# --- tenants -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change", ["template_enrollment = true", "rotation_epoch = rotation_epoch + 1", "mac = NULL"]
)
def test_a_changed_tenant_enrolls_nobody(attacked: Attacked, change: str) -> None:
    enroll(attacked.client)
    attacked.attacker.run(f"UPDATE tenants SET {change} WHERE name = 'default'")
    answer = attacked.client.put("/v1/subjects/bob/enrollment", files=images(photo(2), photo(2, 1)))
    assert_error(answer, 401, "unauthorized")
    assert attacked.problems() == {(TENANT_ALTERED, "default")}


def test_tenants_do_not_change_their_names(attacked: Attacked) -> None:
    token = attacked.deployment.key("verify", tenant="other")
    attacked.attacker.run(
        "UPDATE tenants SET name = 'x' WHERE name = 'default'",
        "UPDATE tenants SET name = 'default' WHERE name = 'other'",
        "UPDATE tenants SET name = 'other' WHERE name = 'x'",
    )
    assert not attacked.accepts(token)
    assert not attacked.accepts(attacked.deployment.token)


def test_a_setting_of_a_tenant_is_not_put_back(attacked: Attacked) -> None:
    attacked.store.tenants.set_template_enrollment("default", True)
    before = attacked.attacker.row("tenants", "name = 'default'")
    attacked.store.tenants.set_template_enrollment("default", False)
    enroll(attacked.client)
    attacked.attacker.run(
        "UPDATE tenants SET template_enrollment = :template_enrollment, line = :line, mac = :mac "
        "WHERE name = 'default'",
        **before,
    )
    with pytest.raises(AlteredTenant):
        attacked.store.tenants.get("default")
    assert attacked.problems() == {(TENANT_ALTERED, "default")}


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
def test_a_lock_is_not_lifted(attacked: Attacked, lift: str, subject: str) -> None:
    token = attacked.locked(subject=subject)
    assert attacked.problems() == set()
    attacked.attacker.run(LIFTS[lift])
    kinds = {what for what, _ in attacked.problems()}
    assert kinds
    assert kinds <= {COUNT_ALTERED, COUNT_VANISHED}
    answer = attacked.decides(token, subject)
    assert assert_error(answer, 423, "locked_out") == {"disabled": False}
    assert 1 <= int(answer.headers["retry-after"]) <= 30
    status = attacked.store.attempts.status("default", subject)
    assert status is not None
    assert status.consecutive == AFTER


def test_a_count_is_not_put_back(attacked: Attacked) -> None:
    """Whoever writes the row of one failure back after each further one would guess for ever."""
    token = attacked.locked(1)
    (one,) = attacked.attacker.rows("failed_attempts")
    for _ in range(AFTER - 1):
        fail(attacked.client, token, 1)
        attacked.attacker.put_back("failed_attempts", one, "pseudonym")
    assert (COUNT_VANISHED, one["pseudonym"]) in attacked.problems()
    assert_error(attacked.decides(token), 423, "locked_out")


def test_lines_that_were_slipped_in_lift_no_lock(attacked: Attacked) -> None:
    """An accept of one's own, copied behind the head."""
    token = attacked.locked(0)
    assert attacked.decides(token).json()["decision"] == "accept"
    accept = attacked.attacker.row("audit_log", "outcome = 'accept'")
    fail(attacked.client, token, AFTER)
    attacked.attacker.run("DELETE FROM failed_attempts")
    attacked.attacker.insert("audit_log", {**accept, "sequence": 10**6})
    assert_error(attacked.decides(token), 423, "locked_out")


def test_a_time_that_is_none_is_no_defect(attacked: Attacked) -> None:
    """SQLite keeps any text where a time should be."""
    if not attacked.attacker.database.is_sqlite:
        pytest.skip("PostgreSQL keeps times only")
    token = attacked.locked(1)
    attacked.attacker.run("UPDATE failed_attempts SET locked_until = 'never'")
    assert_error(attacked.decides(token), 503, "store_unavailable")
    with pytest.raises(StoreError, match="failed_attempts"):
        attacked.problems()
    attacked.attacker.run(
        f"UPDATE api_keys SET expires_at = 'never' WHERE prefix = '{prefix_of(token)}'"
    )
    assert not attacked.accepts(token)


def test_a_made_up_lock_locks_nobody_out(attacked: Attacked) -> None:
    token = attacked.locked(AFTER - 1)
    for _ in range(2):
        attacked.attacker.run(
            "UPDATE failed_attempts SET consecutive = 50, disabled_at = last_failed_at"
        )
        assert attacked.decides(token).json()["decision"] == "accept"


def test_an_operator_lifts_a_lock_whose_row_is_gone(attacked: Attacked) -> None:
    token = attacked.locked()
    attacked.attacker.run("DELETE FROM failed_attempts")
    assert attacked.store.attempts.reset("default", "alice", by=OPERATOR)
    assert attacked.decides(token).json()["decision"] == "accept"
    assert not attacked.store.attempts.reset("default", "alice", by=OPERATOR)


def test_the_locks_of_an_erased_subject_and_tenant_are_gone(attacked: Attacked) -> None:
    """What removes a count rightly does not leave one in the log."""
    store, deployment = attacked.store, attacked.deployment
    attacked.locked()
    store.erasures.erase("default", "alice")
    assert store.attempts.status("default", "alice") is None
    fail(attacked.client, deployment.key("verify", tenant="other"), AFTER, "bob")
    store.tenant_erasures.erase("other")
    assert attacked.problems() == set()
    fail(attacked.client, deployment.key("verify", tenant="other"), 1, "bob")
    status = store.attempts.status("other", "bob")
    assert status is not None
    assert (status.consecutive, status.total) == (1, 1)


# --- nonces --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "forget",
    ["DELETE FROM used_nonces", "UPDATE used_nonces SET expires_at = '2020-01-01 00:00:00'"],
)
def test_a_token_does_not_pass_twice(attacked: Attacked, forget: str) -> None:
    enroll(attacked.client)
    send = attacked.one_use()
    assert send().json()["decision"] == "accept"
    attacked.attacker.run(forget)
    attacked.store.purge()
    assert_error(send(), 401, "replayed")
    assert attacked.problems() == set()


def test_a_nonce_that_served_twice_is_found(attacked: Attacked) -> None:
    """With the lines of the first decision set aside, and put back afterwards."""
    enroll(attacked.client)
    send = attacked.one_use()
    assert send().status_code == 200
    attacked.attacker.drop_triggers()
    line = attacked.attacker.rows("audit_log", "nonce IS NOT NULL")[0]
    attacked.attacker.run(
        "DELETE FROM used_nonces",
        "DELETE FROM audit_log WHERE sequence = :sequence",
        sequence=line["sequence"],
    )
    assert send().status_code == 200
    audit_log = attacked.store.audit_log
    assert not audit_log.verify().intact
    attacked.attacker.insert("audit_log", line)
    assert audit_log.verify().intact
    assert attacked.problems() == {(NONCE_TWICE, f"line {audit_log.head().sequence}")}


# --- the upgrade, and what must still work ---------------------------------------------------


def test_stripping_macs_does_not_make_the_next_start_renew_them(attacked: Attacked) -> None:
    token = attacked.deployment.key("verify")
    attacked.attacker.run(
        f"UPDATE api_keys SET rights = '{ALL_RIGHTS}' WHERE prefix = '{prefix_of(token)}'",
        "UPDATE api_keys SET mac = NULL, line = 0",
        "UPDATE tenants SET mac = NULL, line = 0",
    )
    attacked.store.upgrade()
    assert not attacked.accepts(token)
    assert not attacked.accepts(attacked.deployment.token)


def test_all_still_works_after_the_master_key_is_rotated(attacked: Attacked) -> None:
    token, settings = attacked.locked(2), attacked.deployment.settings
    path = settings.resolved_master_key_file
    MasterKeyring.add_current(path)
    attacked.store.wrapped_keys.rewrap()
    MasterKeyring.drop_retired(path, keep=MasterKeyring.load(path).current)
    assert attacked.decides(token).json()["decision"] == "accept"
    fresh = open_store(settings, open_keyring(settings))
    try:
        fresh.upgrade()
        assert fresh.api_keys.verify(token) is not None
        assert fresh.tenants.get("default").rotation_epoch == 1
        fresh.rerotation.begin("default")
        assert fresh.rerotation.move("default", attacked.deployment.contract.binding) == 1
        fresh.rerotation.retire("default")
        assert fresh.check_records() == ()
    finally:
        fresh.close()
    assert attacked.decides(token).json()["decision"] == "accept"


def test_the_operator_is_warned_without_a_secret(
    attacked: Attacked, caplog: pytest.LogCaptureFixture
) -> None:
    token = attacked.locked(1)
    attacked.attacker.run("DELETE FROM failed_attempts")
    fail(attacked.client, token, 1)
    attacked.attacker.run("UPDATE api_keys SET mac = NULL")
    assert not attacked.accepts(token)
    records: list[Any] = [record for record in caplog.records if record.name == "veilface.store"]
    texts = [f"{record.getMessage()} {record.fields}" for record in records]
    assert any("failed attempts" in text for text in texts)
    assert any(prefix_of(token) in text for text in texts)
    assert not any("alice" in text or token in text for text in texts)


# --- the log as a tenant reads it ----------------------------------------------------------


def test_an_altered_line_is_told_as_such(attacked: Attacked) -> None:
    enroll(attacked.client)
    attacked.attacker.drop_triggers()
    line = list(attacked.store.audit_log.lines())[-1]
    whole = attacked.client.get("/v1/audit-log").json()
    assert [told["altered"] for told in whole["lines"]] == [False] * len(whole["lines"])
    assert {told["sequence"] for told in whole["lines"]} == {None}
    for change in ("outcome = 'replaced'", "hash = previous_hash || hash"):
        attacked.attacker.run(f"UPDATE audit_log SET {change} WHERE sequence = {line.sequence}")
        told = assert_answer(attacked.client.get("/v1/audit-log"), 200, AuditLogAnswer)
        fields = dict.fromkeys(whole["lines"][0])
        assert told["lines"] == [
            {**fields, "altered": True, "sequence": line.sequence},
            *whole["lines"][1:],
        ]
