import pytest
import sqlalchemy as sa

from templates.errors import StoreError
from templates.store import (
    By,
    InvalidIdentifier,
    Receipt,
    Right,
    TemplateStore,
    UnknownTenant,
    verify_audit_log,
    verify_receipt,
)
from templates.store.schema import (
    Base,
    ReceiptRow,
)
from tests.databases import execute
from tests.templates.store.conftest import Clock, put
from tests.templates.store.test_attempts import attempt

OPERATOR = By("operator:kim", "request-1")


def fill(store: TemplateStore, tenant: str, *, subjects: int = 5) -> dict[str, int]:
    """Give a tenant some of everything; returns how much."""
    keys = [store.api_keys.create(tenant, [Right.VERIFY]).key for _ in range(2)]
    store.api_keys.revoke(keys[1].prefix)
    for number in range(subjects):
        put(store, f"s{number}", b"wire", tenant=tenant)
    for number in range(subjects + 2):  # two of them are not enrolled
        assert attempt(store, f"s{number}", tenant=tenant) == "reject"
    store.rerotation.begin(tenant)
    return {
        "subjects": subjects,
        "templates": subjects,
        "data_keys": subjects,
        "rotation_keys": 2,
        "api_keys": 2,
        "failed_attempts": subjects + 2,
    }


def counted(receipt: Receipt) -> dict[str, int]:
    return {entry["item"]: entry["count"] for entry in receipt.claims["erased"]}


def outcomes(store: TemplateStore) -> list[str]:
    return [line.outcome for line in store.audit_log.lines() if line.action == "tenant-erase"]


def test_everything_of_the_tenant_goes_and_nothing_of_another(
    store: TemplateStore, clock: Clock
) -> None:
    mine, theirs = fill(store, "default"), fill(store, "other", subjects=3)
    clock.pass_by(hours=1)
    erasure = store.erasures.erase_tenant("default", by=OPERATOR)
    assert erasure.erased
    assert erasure.log_purged
    assert counted(erasure.receipt) == mine
    claims = verify_receipt(erasure.receipt, store.signer.public_key())
    assert claims["kind"] == "veilface-tenant-erasure-receipt"
    assert (claims["tenant"], claims["held"], claims["version"]) == ("default", True, 1)
    assert claims["erased_at"] == clock.time.isoformat()
    assert "subject" not in claims
    assert erasure.receipt.claims["held"]
    of_tenants = [table for table in Base.metadata.tables.values() if "tenant_id" in table.c]
    left = {table.name: execute(store.database, sa.select(table)) for table in of_tenants}
    # A table that is added, with rows of a tenant, has to be filled by `fill`.
    assert {name: len(rows) for name, rows in left.items()}.items() <= theirs.items()
    assert [tenant.name for tenant in store.tenants.all()] == ["other"]
    with pytest.raises(UnknownTenant):
        store.tenants.get("default")
    assert store.subjects.list("default").records == []
    found = store.subjects.get("other", "s0")
    assert found is not None
    assert outcomes(store) == ["erased"]
    line = list(store.audit_log.lines())[-1]
    assert (line.tenant, line.actor, line.request_id) == ("default", "operator:kim", "request-1")
    assert verify_audit_log(store).intact


def test_erasing_again_gives_the_same_receipt(store: TemplateStore, clock: Clock) -> None:
    fill(store, "default")
    first = store.erasures.erase_tenant("default")
    clock.pass_by(days=1)
    again = store.erasures.erase_tenant("default")
    assert not again.erased
    assert again.receipt == first.receipt
    assert outcomes(store) == ["erased", "receipt_repeated"]


def test_a_tenant_that_never_was_is_unknown(store: TemplateStore) -> None:
    put(store, "ada", b"wire")
    store.erasures.erase("default", "ada")
    with pytest.raises(UnknownTenant, match="'nobody'"):
        store.erasures.erase_tenant("nobody")
    with pytest.raises(InvalidIdentifier):
        store.erasures.erase_tenant("no/body")
    assert outcomes(store) == []


def test_a_tenant_made_anew_has_another_rotation_and_another_epoch(store: TemplateStore) -> None:
    """So a process that keeps rotations by name and epoch never uses the old one for it."""
    store.rerotation.begin("default")
    old = [store.tenants.rotation_key("default", epoch) for epoch in (1, 2)]
    first = store.erasures.erase_tenant("default")
    assert first.receipt.claims["rotation_epoch"] == 2
    tenant = store.tenants.create("default")
    assert tenant.rotation_epoch == 3
    assert store.tenants.rotation_key("default", 3) not in old
    put(store, "ada", b"wire")
    second = store.erasures.erase_tenant("default")
    assert second.erased
    assert second.receipt != first.receipt
    assert counted(second.receipt)["subjects"] == 1
    assert store.tenants.create("default").rotation_epoch == 4
    assert store.tenants.create("fresh").rotation_epoch == 1


def test_a_forged_receipt_sets_no_epoch(store: TemplateStore) -> None:
    """Else a database writer would bring a new tenant into an epoch whose key they know."""
    store.erasures.erase_tenant("default")
    forged = sa.func.replace(ReceiptRow.body, '"rotation_epoch":1', '"rotation_epoch":7')
    execute(store.database, sa.update(ReceiptRow).values(body=forged))
    with pytest.raises(StoreError, match="signature"):
        store.tenants.create("default")
