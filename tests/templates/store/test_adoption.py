"""The one upgrade at which the rows of an earlier version are authenticated as they are."""

import hashlib
import hmac
from datetime import timedelta

import pytest
import sqlalchemy as sa

from templates.keys.sealing import MasterKeyring, encode_parts
from templates.store import By, LockedOut, NewApiKey, Right, TemplateStore
from templates.store.record_check import ACTOR_NEVER_CREATED, KEY_ALTERED, RecordProblem
from templates.store.secret import SecretName
from tests.templates.store.conftest import Clock, finish, put
from tests.templates.store.test_attempts import attempt

STRIPPED = (
    "UPDATE tenants SET line = 0, mac = NULL",
    "UPDATE api_keys SET line = 0, mac = NULL",
    "UPDATE failed_attempts SET line = 0, mac = NULL",
    "UPDATE idempotency SET mac = NULL",
)


def run(store: TemplateStore, *statements: str, **values: object) -> None:
    for statement in statements:
        store.database.write(lambda each, sql=statement: each.execute(sa.text(sql), values))


def as_an_earlier_version_left_it(store: TemplateStore) -> None:
    """No row has a MAC, and the head has the one that it had then."""
    head, key = store.audit_log.head(), store.secrets.get(SecretName.CHAIN).value
    mac = hmac.new(key, encode_parts("head", head.sequence, head.hash), hashlib.sha256).digest()
    run(store, *STRIPPED)
    run(store, "UPDATE audit_head SET mac = :mac", mac=mac)


@pytest.fixture
def filled(store: TemplateStore) -> tuple[TemplateStore, NewApiKey]:
    put(store, "ada", b"wire")
    made = store.api_keys.create("default", [Right.VERIFY])
    for _ in range(5):
        attempt(store)
    claim = store.idempotency.claim("default", actor="a", key="k", request=b"r")
    finish(store, claim, status=200, body=b"{}")
    return store, made


def test_rows_of_an_earlier_version_are_good_after_the_upgrade(
    filled: tuple[TemplateStore, NewApiKey], database_url: str, keyring: MasterKeyring, clock: Clock
) -> None:
    store, made = filled
    as_an_earlier_version_left_it(store)
    assert store.api_keys.verify(made.token) is None
    fresh = TemplateStore(database_url, keyring, clock=clock)
    adoption = fresh.upgrade()
    assert (adoption.rows, adoption.refused) == (2 + 1 + 1 + 1, ())
    assert fresh.api_keys.verify(made.token) is not None
    assert attempt(fresh, accepted=True).startswith("locked")
    answer = fresh.idempotency.claim("default", actor="a", key="k", request=b"r")
    assert answer.body == b"{}"
    # But for the actor of this test's attempts, which is made up.
    assert [each.what for each in fresh.check_records()] == [ACTOR_NEVER_CREATED]
    assert fresh.audit_log.verify().intact
    assert list(fresh.audit_log.lines())[-2].action == "db-upgrade"
    # Once: what is stripped afterwards was stripped by somebody else.
    run(fresh, *STRIPPED)
    assert fresh.upgrade().rows == 0
    assert fresh.api_keys.verify(made.token) is None
    fresh.close()


def test_keys_that_the_log_contradicts_are_left_out(
    filled: tuple[TemplateStore, NewApiKey],
) -> None:
    store, made = filled
    unknown, moved, revived = (store.api_keys.create("default", [Right.VERIFY]) for _ in range(3))
    store.api_keys.revoke(revived.key.prefix)
    as_an_earlier_version_left_it(store)
    run(
        store,
        "UPDATE api_keys SET tenant_id = (SELECT id FROM tenants WHERE name = 'other') "
        f"WHERE prefix = '{moved.key.prefix}'",
        f"UPDATE api_keys SET revoked_at = NULL WHERE prefix = '{revived.key.prefix}'",
        f"UPDATE api_keys SET prefix = '0123456789ab' WHERE prefix = '{unknown.key.prefix}'",
    )
    adoption = store.upgrade()
    assert set(adoption.refused) == {"0123456789ab", moved.key.prefix, revived.key.prefix}
    assert store.api_keys.verify(made.token) is not None
    for token in (moved.token, revived.token):
        assert store.api_keys.verify(token) is None
    assert RecordProblem(KEY_ALTERED, f"key:{moved.key.prefix}") in store.check_records()


def test_a_lock_from_before_is_not_lost_and_not_put_back(
    filled: tuple[TemplateStore, NewApiKey], clock: Clock
) -> None:
    store, _ = filled
    as_an_earlier_version_left_it(store)
    store.upgrade()
    run(store, "DELETE FROM failed_attempts")
    with pytest.raises(LockedOut):
        store.attempts.begin("default", "ada", contract_ids=["c" * 64])
    clock.pass_by(seconds=30)
    assert attempt(store, accepted=True) == "accept"
    assert not store.attempts.reset("default", "ada", by=By())
    clock.pass_by(seconds=timedelta(days=1).total_seconds())
    assert attempt(store) == "reject"
