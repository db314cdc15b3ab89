"""What an attacker who writes the database, but has no master key, can and cannot do.

They cannot make or widen an API key: such a row is as good as none. They can put an earlier row
back, and the service takes it: the verification of the audit log reports it.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import (
    Retention,
    TemplateStore,
    archive_audit_log,
    count_wrapped,
    renew_secrets,
    rewrap_keys,
    verify_audit_log,
)
from templates.store.audit_verification import (
    COUNT_LIFTED,
    ENROLLMENT_PUT_BACK,
    KEY_ALTERED,
    KEY_PUT_BACK,
    TENANT_ALTERED,
    TENANT_PUT_BACK,
)
from tests.databases import execute
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import CONTRACT, Clock, put
from tests.templates.store.test_attempts import attempt


def write(store: TemplateStore, *statements: str, **values: object) -> None:
    execute(store.database, *statements, **values)


def reported(store: TemplateStore) -> list[tuple[str, str]]:
    verification = verify_audit_log(store)
    assert verification.problem is None
    return [(record.what, record.about) for record in verification.records]


@pytest.mark.parametrize(
    "change",
    [
        "rights = 'admin,enroll,verify'",
        "expires_at = NULL",
        "expires_at = '2099-01-01 00:00:00'",
        "lowest_level = NULL",
        "token_hash = (SELECT token_hash FROM api_keys WHERE prefix <> :prefix)",
        "prefix = '000000000000'",
        "id = '00000000000000000000000000000000'",
        "tenant_id = (SELECT id FROM tenants WHERE name = 'other')",
        "revoked_at = '2026-03-01 00:00:00'",
        "mac = (SELECT mac FROM api_keys WHERE prefix <> :prefix)",
    ],
)
def test_a_key_is_not_widened(store: TemplateStore, clock: Clock, change: str) -> None:
    clock.pass_by(days=1)
    made = store.api_keys.create(
        "default", ["verify"], expires_at=clock.time.replace(year=2027), lowest_level="fmr-1e-4"
    )
    other = store.api_keys.create("default", ["admin"])
    assert store.api_keys.verify(made.token) is not None
    write(store, f"UPDATE api_keys SET {change} WHERE prefix = :prefix", prefix=made.key.prefix)
    assert store.api_keys.verify(made.token) is None
    assert store.api_keys.verify(other.token) is not None
    ((what, _),) = reported(store)
    assert what == KEY_ALTERED


def test_a_tenants_new_name_gives_its_keys_no_other_tenant(store: TemplateStore) -> None:
    made = store.api_keys.create("other", ["verify"])
    write(
        store,
        "UPDATE tenants SET name = 'elsewhere' WHERE name = 'default'",
        "UPDATE tenants SET name = 'default' WHERE name = 'other'",
    )
    assert store.api_keys.verify(made.token) is None


def test_a_key_is_not_made_up(store: TemplateStore) -> None:
    made = store.api_keys.create("default", ["verify"])
    columns = "tenant_id, token_hash, rights, label, created_at, mac"
    write(
        store,
        f"INSERT INTO api_keys (id, prefix, {columns}) "
        f"SELECT 'f', 'aaaaaaaaaaaa', {columns} FROM api_keys",
    )
    token = made.token.replace(made.key.prefix, "aaaaaaaaaaaa")
    assert store.api_keys.verify(token) is None
    assert reported(store) == [(KEY_ALTERED, "key:aaaaaaaaaaaa")]


KEEP = "CREATE TABLE {0}_kept AS SELECT * FROM {0}"
PUT_BACK = ("DELETE FROM {0}", "INSERT INTO {0} SELECT * FROM {0}_kept")


def put_back(store: TemplateStore, table: str, meanwhile: Callable[[], object]) -> None:
    """Bring a table back to the state in which it was before something happened."""
    write(store, KEEP.format(table))
    meanwhile()
    write(store, *(statement.format(table) for statement in PUT_BACK))


def test_a_revocation_that_was_undone_is_reported(store: TemplateStore) -> None:
    made = store.api_keys.create("default", ["verify"])
    put_back(store, "api_keys", lambda: store.api_keys.revoke(made.key.prefix))
    assert store.api_keys.verify(made.token) is not None  # what the threat model says
    assert reported(store) == [(KEY_PUT_BACK, f"key:{made.key.prefix}")]
    store.api_keys.revoke(made.key.prefix)
    assert reported(store) == []


def test_a_key_of_an_erased_tenant_that_was_put_back_is_reported(store: TemplateStore) -> None:
    made = store.api_keys.create("other", ["verify"])
    write(store, KEEP.format("tenants"), KEEP.format("api_keys"))
    store.erasures.erase_tenant("other")
    write(
        store,
        "INSERT INTO tenants SELECT * FROM tenants_kept WHERE name = 'other'",
        "INSERT INTO api_keys SELECT * FROM api_keys_kept",
    )
    assert store.api_keys.verify(made.token) is not None
    assert reported(store) == [(TENANT_PUT_BACK, "other")]


@pytest.mark.parametrize("whole_tenant", [True, False])
def test_an_erased_enrollment_that_was_put_back_is_reported(
    store: TemplateStore, whole_tenant: bool
) -> None:
    for name in ("ada", "eve"):
        put(store, name, b"wire", tenant="other")
    write(store, *(KEEP.format(table) for table in ("tenants", "subjects")))
    if whole_tenant:
        store.erasures.erase_tenant("other")
        write(store, "INSERT INTO tenants SELECT * FROM tenants_kept WHERE name = 'other'")
    else:
        store.erasures.erase("other", "ada")
        store.erasures.erase("other", "eve")
    put(store, "eve", b"wire", tenant="other", rotation_epoch=None)
    write(store, "INSERT INTO subjects SELECT * FROM subjects_kept WHERE subject_id = 'ada'")
    ada = (ENROLLMENT_PUT_BACK, store.signer.pseudonym("other", "ada"))
    assert reported(store) == ([(TENANT_PUT_BACK, "other")] if whole_tenant else [ada])


def test_a_replaced_enrollment_that_was_put_back_is_reported(
    store: TemplateStore, tmp_path: Path
) -> None:
    put(store, "ada", b"one")
    archive_audit_log(store, tmp_path / "before.jsonl", through=None)
    write(store, KEEP.format("subjects"))
    put(store, "ada", b"two")
    assert reported(store) == []
    write(store, "DELETE FROM subjects", "INSERT INTO subjects SELECT * FROM subjects_kept")
    ada = [(ENROLLMENT_PUT_BACK, store.signer.pseudonym("default", "ada"))]
    assert reported(store) == ada
    store.erasures.erase("default", "ada")
    assert reported(store) == []
    write(store, "INSERT INTO subjects SELECT * FROM subjects_kept")
    assert reported(store) == ada


def test_a_setting_of_a_tenant_that_was_changed_is_reported(store: TemplateStore) -> None:
    store.tenants.set_template_enrollment("default", False)
    assert reported(store) == []
    write(store, "UPDATE tenants SET template_enrollment = NOT template_enrollment")
    assert reported(store) == [(TENANT_ALTERED, "default")]


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("change", ["expires_at = 'x'", "created_at = 'x'", "rights = x'00'"])
def test_a_key_row_that_cannot_be_read_is_reported(store: TemplateStore, change: str) -> None:
    made = store.api_keys.create("default", ["verify"])
    write(store, f"UPDATE api_keys SET {change}")
    with pytest.raises(StoreError, match="was altered"):
        store.api_keys.verify(made.token)
    assert reported(store) == [(KEY_ALTERED, "a row that cannot be read")]


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_a_key_whose_mac_is_a_text_is_revoked_and_never_vouched_for(
    store: TemplateStore, tmp_path: Path
) -> None:
    made = store.api_keys.create("default", ["verify"])
    write(store, "UPDATE api_keys SET mac = 'text'")
    assert store.api_keys.verify(made.token) is None
    assert store.api_keys.revoke(made.key.prefix)
    archive = tmp_path / "archive.jsonl"
    write(store, "UPDATE api_keys SET created_at = 'x'")
    with pytest.raises(StoreError, match="was altered"):
        renew_secrets(store, archive)
    assert not archive.exists()
    write(store, "UPDATE api_keys SET created_at = '2026-03-01 00:00:00'")
    assert renew_secrets(store, archive).refused == (made.key.prefix,)
    assert reported(store) == [(KEY_ALTERED, f"key:{made.key.prefix}")]


UNREADABLE = ["source = 'zzz'", "created_at = 'zzz'", "last_used_at = 7", "photos = 'zzz'"]


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("change", [*UNREADABLE, "rotation_epoch = 'zzz'"])
def test_a_subject_whose_row_cannot_be_read_is_still_replaced_and_erased(
    store: TemplateStore, clock: Clock, key_file: Path, change: str
) -> None:
    damage = f"UPDATE subjects SET {change} WHERE subject_id = 'ada'"
    for name in ("ada", "eve"):
        put(store, name, b"wire")
    write(store, damage)
    for read in (
        lambda: store.subjects.list("default"),
        lambda: store.subjects.describe("default", "ada"),
        lambda: attempt(store),
    ):
        with pytest.raises(StoreError, match="was altered") as caught:
            read()
        assert "zzz" not in str(caught.value)
        assert caught.value.__suppress_context__
    current = MasterKeyring.add_current(key_file)
    rewrap_keys(store)
    assert set(count_wrapped(store)) == {current}
    assert put(store, "ada", b"other")
    write(store, damage)
    assert store.erasures.erase("default", "ada").receipt.claims["contract_id"] == CONTRACT
    put(store, "ada", b"wire")
    write(store, damage)
    clock.pass_by(days=2)
    assert store.erasures.erase_expired(Retention(timedelta(days=1))) == 2


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_a_row_that_cannot_be_erased_stops_no_other(store: TemplateStore, clock: Clock) -> None:
    for tenant in ("default", "other"):
        for name in ("ada", "eve"):
            put(store, name, b"wire", tenant=tenant)
    write(store, "UPDATE tenants SET rotation_epoch = 'x' WHERE name = 'default'")
    clock.pass_by(days=2)
    with pytest.raises(StoreError, match=r"2 subjects .* could not be erased.* 2 were erased"):
        store.erasures.erase_expired(Retention(timedelta(days=1)), batch=1)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_a_wrapped_key_that_is_a_text_is_counted_and_the_rest_is_wrapped_again(
    store: TemplateStore, key_file: Path
) -> None:
    for name in ("ada", "eve"):
        put(store, name, b"wire")
    write(store, "UPDATE subjects SET wrapped_key = 'zzz' WHERE subject_id = 'ada'")
    current = MasterKeyring.add_current(key_file)
    with pytest.raises(SealError, match="1 blobs do not open"):
        rewrap_keys(store)
    assert set(count_wrapped(store)) == {current, "unreadable"}
    with pytest.raises(SealError):
        store.subjects.get("default", "ada")


@pytest.mark.parametrize("enrolled", [True, False])
def test_a_lock_that_was_lifted_is_reported(store: TemplateStore, enrolled: bool) -> None:
    if enrolled:
        put(store, "ada", b"wire")
    for _ in range(5):
        attempt(store)
    assert attempt(store) == "locked 30"
    assert reported(store) == []
    lifted = [(COUNT_LIFTED, store.signer.pseudonym("default", "ada"))]
    for change in (
        "UPDATE failed_attempts SET last_failed_at = '2027-01-01 00:00:00+00'",
        "UPDATE failed_attempts SET last_failed_at = '2026-01-01 00:00:00+00'",
        "UPDATE failed_attempts SET consecutive = 4",
        "DELETE FROM failed_attempts",
    ):
        if "SET last" in change and store.database.is_sqlite:
            change = change.replace("+00'", ".000000'")
        write(store, change)
        assert reported(store) == lifted, change
    assert attempt(store) == "reject"
    assert reported(store) == lifted


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("change", ["consecutive = 'x'", "last_failed_at = 'x'"])
def test_a_count_that_cannot_be_read_is_reported(store: TemplateStore, change: str) -> None:
    attempt(store)
    write(store, f"UPDATE failed_attempts SET {change}")
    with pytest.raises(StoreError, match="was altered"):
        attempt(store)
    assert reported(store) == [(COUNT_LIFTED, "a row that cannot be read")]


def test_what_ends_a_count_rightly_is_not_reported(store: TemplateStore, clock: Clock) -> None:
    for name in ("ada", "eve", "kim"):
        put(store, name, b"wire")
    store.tenants.create("third")
    for _ in range(3):
        for name in ("ada", "eve", "kim", "late"):
            attempt(store, name)
        attempt(store, "ada", tenant="third")
    attempt(store, "ada", accepted=True)
    store.erasures.erase("default", "eve")
    store.erasures.erase_tenant("third")
    assert reported(store) == []
    attempt(store, "ada")
    clock.pass_by(days=91)
    store.purge()
    assert reported(store) == []


def test_what_an_archive_tells_is_not_looked_at(store: TemplateStore, tmp_path: Path) -> None:
    made = store.api_keys.create("default", ["verify"])
    put_back(store, "api_keys", lambda: store.api_keys.revoke(made.key.prefix))
    archive_audit_log(store, tmp_path / "audit.jsonl", through=None)
    assert reported(store) == []


def test_rows_are_looked_at_beside_a_write(store: TemplateStore) -> None:
    attempt(store)

    with store.database.write() as session:
        session.execute(sa.text("UPDATE failed_attempts SET consecutive = 0"))
        with ThreadPoolExecutor(1) as thread:
            assert thread.submit(verify_audit_log, store).result(PATIENCE_S).intact
    assert reported(store) != []


def test_rows_are_looked_at_only_where_the_log_is_whole(store: TemplateStore) -> None:
    attempt(store)
    write(store, "DELETE FROM failed_attempts", "UPDATE audit_log SET detail = 'low'")
    verification = verify_audit_log(store)
    assert verification.problem is not None
    assert verification.records == ()
