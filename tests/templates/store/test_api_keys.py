import hashlib
import hmac
from datetime import timedelta
from unittest import mock

import pytest
import sqlalchemy as sa

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import Right, TemplateStore, UnknownTenant
from templates.store.database import Database
from templates.store.schema import ApiKeyRow
from tests.databases import execute
from tests.templates.store.conftest import Clock
from tests.templates.store.test_database import with_options


def test_a_token_finds_its_key(store: TemplateStore, clock: Clock) -> None:
    new = store.api_keys.create("default", [Right.ENROLL, "verify"], label="front end")
    start, prefix, secret = new.token.split("_")
    assert (start, prefix, len(secret)) == ("vf", new.key.prefix, 64)
    assert new.key.is_valid_at(clock.time)
    found = store.api_keys.verify(new.token)
    assert found is not None
    assert (found.tenant, found.label) == ("default", "front end")
    assert found.rights == {Right.ENROLL, Right.VERIFY}
    assert found.created_at == clock.time


def test_the_token_is_not_stored_and_does_not_show(store: TemplateStore, database_url: str) -> None:
    new = store.api_keys.create("default", [Right.VERIFY])
    secret = new.token.split("_")[2]
    assert secret not in repr(new)
    database = Database(database_url)
    (row,) = execute(database, sa.select(ApiKeyRow.__table__))
    assert row.token_hash == hashlib.sha256(new.token.encode()).digest()
    for value in row:
        stored = value if isinstance(value, bytes) else str(value).encode()
        assert secret.encode() not in stored
        assert bytes.fromhex(secret) not in stored
    database.close()


def test_a_wrong_token_is_refused(store: TemplateStore) -> None:
    token = store.api_keys.create("default", [Right.VERIFY]).token
    last = "0" if token[-1] != "0" else "1"
    _, prefix, secret = token.split("_")
    for wrong in (
        "",
        "vf_",
        prefix,
        token[:-1],
        token[:-1] + last,
        token + "0",
        token.upper(),
        f" {token}",
        f"{token}\n",
        f"vf_{'0' * 12}_{secret}",
        f"vf_{prefix}_{'0' * 64}",
        "vf_" + "x" * 100_000,
        "vf_\udc80",
    ):
        assert store.api_keys.verify(wrong) is None, wrong
    assert store.api_keys.verify(token) is not None


def test_every_token_is_compared_in_constant_time(store: TemplateStore) -> None:
    """An unknown prefix runs the same comparison as a known one with a wrong secret."""
    token = store.api_keys.create("default", [Right.VERIFY]).token
    wrong = token[:-1] + ("0" if token[-1] != "0" else "1")
    with mock.patch("templates.store.api_keys.hmac.compare_digest", wraps=hmac.compare_digest) as c:
        for each in (wrong, f"vf_{'0' * 12}_{'0' * 64}", "nonsense"):
            assert store.api_keys.verify(each) is None
    assert c.call_count == 3
    assert all(len(call.args[0]) == len(call.args[1]) == 32 for call in c.call_args_list)


def test_expiry_and_revocation(store: TemplateStore, clock: Clock) -> None:
    keys = store.api_keys
    short = keys.create("default", [Right.VERIFY], expires_at=clock.time + timedelta(hours=1))
    long = keys.create("default", [Right.VERIFY])
    assert keys.verify(short.token)
    clock.pass_by(minutes=59, seconds=59)
    assert keys.verify(short.token)
    clock.pass_by(seconds=1)
    assert keys.verify(short.token) is None
    assert keys.verify(long.token)
    assert keys.revoke(long.key.prefix)
    assert not keys.revoke(long.key.prefix)
    assert not keys.revoke("nothing")
    assert keys.verify(long.token) is None
    listed = {key.prefix: key for key in keys.all()}
    assert listed[long.key.prefix].revoked_at == clock.time


def test_nonsense_is_refused(store: TemplateStore) -> None:
    with pytest.raises(UnknownTenant):
        store.api_keys.create("nobody", [Right.VERIFY])
    with pytest.raises(StoreError, match="at least one right"):
        store.api_keys.create("default", [])
    with pytest.raises(StoreError, match="enroll, verify"):
        store.api_keys.create("default", ["root"])
    for label in ("x" * 129, "a\nb"):
        with pytest.raises(StoreError, match="label"):
            store.api_keys.create("default", [Right.VERIFY], label=label)
    with pytest.raises(StoreError, match="name of a level"):
        store.api_keys.create("default", [Right.VERIFY], lowest_level="Not A Level")


def test_a_read_only_database_refuses_no_good_key(
    postgres_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(postgres_url, keyring)
    store.upgrade()
    store.tenants.create("default")
    token = store.api_keys.create("default", [Right.VERIFY]).token
    read_only = TemplateStore(
        with_options(postgres_url, "-c default_transaction_read_only=on"), keyring
    )
    key = read_only.api_keys.verify(token)
    assert key is not None
    with pytest.raises(StoreError):
        read_only.api_keys.revoke(key.prefix)
    store.close()
    read_only.close()
