import json
import random
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import Receipt, Retention, TemplateStore, verify_receipt
from templates.store.database import Database
from templates.store.receipts import key_fingerprint
from templates.store.schema import (
    FailedAttemptsRow,
    RotationKeyRow,
    SubjectRow,
    TenantRow,
)
from tests.databases import execute
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import (
    CONTRACT,
    Clock,
    compact_until,
    count,
    found,
    pieces,
    put,
)
from tests.templates.store.test_attempts import attempt


def test_everything_about_the_subject_goes_at_once(
    store: TemplateStore,
) -> None:
    for name in ("ada", "eve"):
        put(store, name, b"wire")
        attempt(store, name)

    erasure = store.erasures.erase("default", "ada")

    assert erasure.erased
    assert erasure.log_purged
    assert erasure.receipt.claims["held"]
    assert store.subjects.get("default", "ada") is None
    assert store.subjects.describe("default", "ada") is None
    for table in (SubjectRow, FailedAttemptsRow):
        assert count(store, table) == 1, table  # eve's
    assert store.subjects.get("default", "eve") is not None
    claims = verify_receipt(erasure.receipt, store.signer.public_key())
    assert claims["contract_id"] == CONTRACT
    assert claims["erased"] == [
        {"item": "template", "count": 1},
        {"item": "data_key", "count": 1},
        {"item": "metadata", "count": 1},
        {"item": "failed_attempts", "count": 1},
    ]


def test_erasing_who_was_never_enrolled_says_so(store: TemplateStore) -> None:
    erasure = store.erasures.erase("default", "nobody")
    assert not erasure.erased
    assert not erasure.receipt.claims["held"]
    assert erasure.receipt.claims["contract_id"] is None
    assert {entry["count"] for entry in erasure.receipt.claims["erased"]} == {0}
    assert store.erasures.erase("default", "nobody").receipt == erasure.receipt


def test_a_receipt_is_canonical_and_names_the_subject_by_its_pseudonym_only(
    store: TemplateStore, clock: Clock
) -> None:
    put(store, "lovelace", b"wire")
    receipt = store.erasures.erase("default", "lovelace").receipt
    assert "lovelace" not in json.dumps(receipt.to_json())
    claims = verify_receipt(receipt, store.signer.public_key())
    assert receipt.body == json.dumps(claims, sort_keys=True, separators=(",", ":"))
    assert claims["subject"] == store.signer.pseudonym("default", "lovelace")
    assert (claims["tenant"], claims["held"]) == ("default", True)
    assert claims["signing_key"] == key_fingerprint(store.signer.public_key())
    assert datetime.fromisoformat(claims["erased_at"]) == clock.time
    other = store.erasures.erase("default", "eve").receipt
    assert other.claims["receipt_id"] != claims["receipt_id"]


def test_an_altered_or_foreign_receipt_is_refused(store: TemplateStore, tmp_path: Path) -> None:
    receipt = store.erasures.erase("default", "ada").receipt
    key = store.signer.public_key()
    altered = Receipt(receipt.body.replace("false", "true"), receipt.signature)
    assert altered.body != receipt.body
    with pytest.raises(StoreError, match="signature"):
        verify_receipt(altered, key)
    foreign = TemplateStore(
        f"sqlite:///{tmp_path / 'foreign.db'}", MasterKeyring.create(tmp_path / "foreign.key")
    )
    foreign.upgrade()
    with pytest.raises(StoreError, match="signature"):
        verify_receipt(receipt, foreign.signer.public_key())
    with pytest.raises(StoreError, match="32 bytes"):
        verify_receipt(receipt, b"short")
    names = [("default", "ada"), ("default", "eve"), ("a", "bc"), ("ab", "c")]
    pseudonyms = {each.signer.pseudonym(*name) for each in (store, foreign) for name in names}
    assert len(pseudonyms) == 2 * len(names)  # keyed, and unambiguous
    foreign.close()


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        {},
        {"body": "x"},
        {"body": 1, "signature": "AA=="},
        {"body": "x", "signature": "!"},
        {"body": "x", "signature": "AA==", "more": 1},
    ],
)
def test_what_is_no_receipt_is_refused(value: object) -> None:
    with pytest.raises(StoreError):
        Receipt.from_json(value)


GONE = "subject-0007"
REMOVALS: dict[str, Callable[[TemplateStore], object]] = {
    "erase": lambda store: store.erasures.erase("default", GONE),
    "replace": lambda store: put(store, GONE, bytes(17_000)),
    "tenant": lambda store: store.erasures.erase_tenant("default"),
    "retention": lambda store: store.erasures.erase_expired(Retention(timedelta(5)), batch=4),
}


@pytest.mark.parametrize("action", REMOVALS)
def test_sqlite_files_keep_nothing_of_what_was_removed(
    tmp_path: Path, keyring: MasterKeyring, clock: Clock, action: str
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    store = TemplateStore(f"sqlite:///{folder / 'veilface.db'}", keyring, clock=clock)
    store.upgrade()
    for tenant in ("default", "other"):
        store.tenants.create(tenant)
    generator = random.Random(3)
    for number in range(20):
        put(store, f"subject-{number:04}", generator.randbytes(17_000))
    label = store.api_keys.create("default", ["verify"], label="a label to look for").key.label
    clock.pass_by(days=10)
    put(store, "survivor", generator.randbytes(17_000), tenant="other")

    of_subject = sa.select(SubjectRow.wrapped_key, SubjectRow.ciphertext)
    (blobs,) = execute(store.database, of_subject.where(SubjectRow.subject_id == GONE))
    if action == "tenant":
        tenant = sa.select(TenantRow.id).where(TenantRow.name == "default").scalar_subquery()
        key = sa.select(RotationKeyRow.wrapped_key).where(RotationKeyRow.tenant_id == tenant)
        blobs = (*blobs, *execute(store.database, key)[0])
    # The first bytes of a sealed blob name its master key, which others share.
    wanted = [piece for blob in blobs for piece in pieces(blob[9:])]
    wanted += [] if action == "replace" else [GONE.encode()]
    wanted += [label.encode()] if action == "tenant" else []
    # The control: before the removal they are all there.
    assert max(found(folder, wanted).values()) >= 0.95 * len(wanted)
    REMOVALS[action](store)
    assert found(folder, wanted) == {}
    assert (folder / "veilface.db-wal").stat().st_size == 0
    assert store.subjects.get("other", "survivor") is not None
    store.close()


def test_a_long_reader_delays_the_purge_and_is_reported(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    url = f"sqlite:///{tmp_path / 'veilface.db'}"
    store = TemplateStore(url, keyring, timeout=PATIENCE_S)  # which no purge waits for
    store.upgrade()
    store.tenants.create("default")
    put(store, "ada", b"wire" * 1000)
    database = Database(url)

    with database.read() as session:
        assert session.scalars(sa.select(SubjectRow.id)).all()
        assert not store.erasures.erase("default", "ada").log_purged
        assert execute(store.database, "PRAGMA busy_timeout") == [(1_000 * PATIENCE_S,)]
    assert store.subjects.get("default", "ada") is None
    assert store.purge()
    assert (tmp_path / "veilface.db-wal").stat().st_size == 0
    database.close()
    store.close()


def test_postgresql_keeps_no_row_after_compacting(
    postgres_url: str, keyring: MasterKeyring
) -> None:
    """What the documentation says of VACUUM: dead rows are in the table's file until then."""
    store = TemplateStore(postgres_url, keyring)
    store.upgrade()
    store.tenants.create("default")
    put(store, "ada", random.Random(4).randbytes(300))
    database = Database(postgres_url)

    def relation_size() -> int:
        return int(execute(database, "SELECT pg_relation_size('subjects')")[0][0])

    store.erasures.erase("default", "ada")
    assert relation_size() > 0
    compact_until(store, lambda: relation_size() == 0)
    assert store.erasures.receipt("default", "ada") is not None
    database.close()
    store.close()
