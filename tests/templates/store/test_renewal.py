"""After a theft of the database together with its master key: every secret made anew."""

from pathlib import Path

import pytest

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import (
    BrokenAuditLog,
    By,
    TemplateStore,
    renew_secrets,
    verify_receipt,
)
from templates.store.secrets import SecretName
from tests.databases import execute
from tests.templates.store.conftest import put


def renew(store: TemplateStore, tmp_path: Path) -> Path:
    archive = tmp_path / "before.jsonl"
    renew_secrets(store, archive, by=By("operator:root"))
    return archive


def secrets_of(store: TemplateStore) -> dict[SecretName, bytes]:
    return {name: store.secrets.get(name) for name in SecretName}


def test_every_secret_but_those_that_stay_is_drawn_anew(
    store: TemplateStore, database_url: str, keyring: MasterKeyring, tmp_path: Path
) -> None:
    before = secrets_of(store)
    put(store, "ada", b"wire")
    renew(store, tmp_path)
    after = secrets_of(store)
    unchanged = {name for name in SecretName if before[name] == after[name]}
    assert unchanged == {SecretName.PSEUDONYM, SecretName.LIFTS}
    fresh = TemplateStore(database_url, keyring)
    assert secrets_of(fresh) == after
    fresh.close()


def test_a_key_that_was_made_up_before_is_not_vouched_for(
    store: TemplateStore, tmp_path: Path
) -> None:
    good, bad = (store.api_keys.create("default", ["verify"]) for _ in range(2))
    execute(
        store.database, f"UPDATE api_keys SET rights = 'admin' WHERE prefix = '{bad.key.prefix}'"
    )
    renewed = renew_secrets(store, tmp_path / "before.jsonl")
    assert renewed.refused == (bad.key.prefix,)
    assert store.api_keys.verify(good.token) is not None
    assert store.api_keys.verify(bad.token) is None


def test_receipts_are_signed_again_where_they_were_good(
    store: TemplateStore, tmp_path: Path
) -> None:
    for name in ("ada", "eve"):
        put(store, name, b"wire")
        store.erasures.erase("default", name)
    before = store.erasures.receipt("default", "ada")
    assert before is not None
    execute(
        store.database,
        "UPDATE receipts SET body = replace(body, 'erased', 'ERASED') WHERE sequence = 2",
    )
    renewed = renew_secrets(store, tmp_path / "before.jsonl")
    assert renewed.receipts == 1
    ada, eve = (store.erasures.receipt("default", name) for name in ("ada", "eve"))
    assert ada is not None
    assert eve is not None
    claims = verify_receipt(ada, store.signer.public_key())
    changes = {"signing_key"}
    assert {name for name in claims if claims[name] != before.claims[name]} == changes
    for receipt in (before, eve):
        with pytest.raises(StoreError):
            verify_receipt(receipt, store.signer.public_key())


def test_a_log_that_is_not_whole_is_looked_at_first(store: TemplateStore, tmp_path: Path) -> None:
    put(store, "ada", b"wire")
    before = secrets_of(store)
    execute(store.database, "UPDATE audit_log SET actor = 'program2'")
    with pytest.raises(BrokenAuditLog):
        renew(store, tmp_path)
    assert secrets_of(store) == before
    assert not (tmp_path / "before.jsonl").exists()
