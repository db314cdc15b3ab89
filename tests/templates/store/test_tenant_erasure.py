import json
import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait
from datetime import timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import (
    By,
    InvalidIdentifier,
    Nonce,
    Receipt,
    Right,
    TemplateStore,
    UnknownTenant,
    verify_receipt,
)
from templates.store.database import Database
from templates.store.schema import (
    ApiKeyRow,
    Base,
    FailedAttemptsRow,
    RotationKeyRow,
    SubjectRow,
    TemplateRow,
    TenantErasureRow,
    TenantRow,
    UsedNonceRow,
)
from templates.store.tenant_erasure import TenantErasure
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import Clock, SlowSealing, compact_until, put, template_id
from tests.templates.store.test_erasure import count, found, pieces

OPERATOR = By("operator:kim", "request-1")
OF_A_TENANT = (
    SubjectRow,
    TemplateRow,
    RotationKeyRow,
    ApiKeyRow,
    FailedAttemptsRow,
    UsedNonceRow,
    TenantErasureRow,
    TenantRow,
)


def fill(store: TemplateStore, tenant: str, *, subjects: int = 5) -> dict[str, int]:
    """Give a tenant some of everything; returns how much."""
    keys = [store.api_keys.create(tenant, [Right.VERIFY]).key for _ in range(2)]
    store.api_keys.revoke(keys[1].prefix)
    for number in range(subjects):
        put(store, f"s{number}", b"wire", tenant=tenant)
    for number in range(subjects + 2):  # two of them are not enrolled
        store.attempts.conclude(
            tenant,
            f"s{number}",
            accepted=False,
            template_id=template_id(store, f"s{number}", tenant),
            level="m",
            nonce=Nonce(
                keys[0].prefix, f"nonce {number}", store._context.clock() + timedelta(hours=1)
            ),
            by=By(),
        )
    store.rerotation.begin(tenant)
    return {
        "subjects": subjects,
        "templates": subjects,
        "data_keys": subjects,
        "rotation_keys": 2,
        "api_keys": 2,
        "failed_attempts": subjects + 2,
        "nonces": subjects + 2,
    }


def counted(receipt: Receipt) -> dict[str, int]:
    return {entry["item"]: entry["count"] for entry in receipt.claims["erased"]}


def outcomes(store: TemplateStore) -> list[str]:
    return [line.outcome for line in store.audit_log.lines() if line.action == "tenant-erase"]


def nothing_is_left(store: TemplateStore, *, tenants: int) -> bool:
    """Whether the tables hold what empty tenants hold: their row and a rotation key."""
    held = {table: count(store.database, table) for table in OF_A_TENANT}
    expected = dict.fromkeys(OF_A_TENANT, 0) | {TenantRow: tenants, RotationKeyRow: tenants}
    return held == expected


@pytest.mark.parametrize("batch", [2, 200])
def test_everything_of_the_tenant_goes_and_nothing_of_another(
    store: TemplateStore, clock: Clock, batch: int
) -> None:
    mine, theirs = fill(store, "default"), fill(store, "other", subjects=3)
    held = store.tenant_erasures.held("default")
    assert {each["item"]: each["count"] for each in held.items} == mine
    clock.pass_by(hours=1)
    erasure = store.tenant_erasures.erase("default", by=OPERATOR, batch=batch)
    assert erasure.erased
    assert erasure.log_purged
    assert counted(erasure.receipt) == mine
    claims = verify_receipt(erasure.receipt, store.signer.public_key())
    assert claims["kind"] == "veilface-tenant-erasure-receipt"
    assert (claims["tenant"], claims["held"], claims["version"]) == ("default", True, 1)
    assert claims["erased_at"] == clock.time.isoformat()
    assert "subject" not in claims
    assert erasure.receipt.held
    left = {
        table: count(store.database, table) for table in OF_A_TENANT if table is not TemplateRow
    }
    assert left == {
        SubjectRow: theirs["subjects"],
        RotationKeyRow: theirs["rotation_keys"],
        ApiKeyRow: theirs["api_keys"],
        FailedAttemptsRow: theirs["failed_attempts"],
        UsedNonceRow: theirs["nonces"],
        TenantErasureRow: 0,
        TenantRow: 1,
    }
    assert count(store.database, TemplateRow) == theirs["templates"]
    for call in (store.tenants.get, store.tenant_erasures.held):
        with pytest.raises(UnknownTenant):
            call("default")
    assert store.subjects.list("default").records == ()
    found = store.subjects.get("other", "s0")
    assert found is not None
    assert outcomes(store) == ["begun", "erased"]
    line = list(store.audit_log.lines())[-1]
    assert (line.tenant, line.actor, line.request_id) == ("default", "operator:kim", "request-1")
    assert store.audit_log.verify().intact


def test_its_keys_are_revoked_before_anything_goes(store: TemplateStore) -> None:
    fill(store, "default")
    token = store.api_keys.create("default", [Right.ENROLL]).token
    seen: list[bool] = []

    def look(removed: int) -> None:
        assert store.api_keys.verify(token) is None
        key = store.api_keys.get(token.split("_")[1])
        seen.append(key is not None and key.revoked_at is not None)

    store.tenant_erasures.erase("default", progress=look)
    assert seen
    assert all(seen)
    assert store.api_keys.verify(token) is None


def test_erasing_again_gives_the_same_receipt(store: TemplateStore, clock: Clock) -> None:
    fill(store, "default")
    first = store.tenant_erasures.erase("default")
    clock.pass_by(days=1)
    again = store.tenant_erasures.erase("default")
    assert not again.erased
    assert again.receipt == first.receipt == store.tenant_erasures.receipt("default")
    assert outcomes(store) == ["begun", "erased", "receipt_repeated"]


def test_a_tenant_that_never_was_is_unknown(store: TemplateStore) -> None:
    put(store, "ada", b"wire")
    store.erasures.erase("default", "ada")
    with pytest.raises(UnknownTenant, match="'nobody'"):
        store.tenant_erasures.erase("nobody")
    with pytest.raises(InvalidIdentifier):
        store.tenant_erasures.erase("no/body")
    assert store.tenant_erasures.receipt("default") is None
    assert outcomes(store) == []


def test_an_interrupted_erasure_is_finished_and_counts_everything(store: TemplateStore) -> None:
    everything = fill(store, "default")

    def stop(removed: int) -> None:
        raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            store.tenant_erasures.erase("default", batch=2, progress=stop)
    assert count(store.database, SubjectRow) == 1
    assert count(store.database, TemplateRow) == 1
    erasure = store.tenant_erasures.erase("default", batch=2)
    assert counted(erasure.receipt) == everything
    assert outcomes(store) == ["begun", "resumed", "resumed", "erased"]
    assert nothing_is_left(store, tenants=1)


def test_a_tenant_made_anew_has_another_rotation_and_another_epoch(store: TemplateStore) -> None:
    """So a process that keeps rotations by name and epoch never uses the old one for it."""
    store.rerotation.begin("default")
    old = {epoch: store.tenants.rotation_key("default", epoch=epoch).key for epoch in (1, 2)}
    first = store.tenant_erasures.erase("default")
    assert first.receipt.claims["rotation_epoch"] == 2
    tenant = store.tenants.create("default")
    assert tenant.rotation_epoch == 3
    assert store.tenants.rotation_key("default").key not in old.values()
    put(store, "ada", b"wire")
    second = store.tenant_erasures.erase("default")
    assert second.erased
    assert second.receipt != first.receipt
    assert counted(second.receipt)["subjects"] == 1
    assert store.tenants.create("default").rotation_epoch == 4
    assert store.tenants.create("fresh").rotation_epoch == 1


def test_a_receipt_of_a_tenant_survives_json_and_shows_alteration(store: TemplateStore) -> None:
    receipt = store.tenant_erasures.erase("default").receipt
    key = store.signer.public_key()
    assert Receipt.from_json(json.loads(json.dumps(receipt.to_json()))) == receipt
    altered = Receipt(receipt.body.replace("default", "defaulT"), receipt.signature)
    with pytest.raises(StoreError, match="signature"):
        verify_receipt(altered, key)


def test_no_second_bootstrap_key_after_the_only_tenant_is_erased(store: TemplateStore) -> None:
    assert store.api_keys.bootstrap() is not None
    store.tenant_erasures.erase("default")
    assert count(store.database, ApiKeyRow) == 0
    assert store.api_keys.bootstrap() is None


@pytest.mark.parametrize("tenant_goes_first", [False, True])
def test_concurrent_enrollments_leave_nothing(
    store: TemplateStore, database_url: str, key_file: Path, tenant_goes_first: bool
) -> None:
    service = TemplateStore(database_url, MasterKeyring.load(key_file))
    fill(store, "default", subjects=0 if tenant_goes_first else 40)
    errors: list[BaseException] = []
    acknowledged: list[str] = []
    ready, done = threading.Barrier(4), threading.Event()

    def enroll(seed: int) -> None:
        generator = random.Random(seed)
        ready.wait()
        while True:
            name = f"s{generator.randrange(60)}"
            over = done.is_set()
            time.sleep(0.005)  # SQLite's lock is polled: without a pause others never get it
            try:
                match generator.randrange(3):
                    case 0:
                        service.erasures.erase("default", name)
                    case 1:
                        service.attempts.conclude(
                            "default",
                            name,
                            accepted=False,
                            template_id=None,
                            contract_id="of another one",
                            level="m",
                            nonce=None,
                            by=By(),
                        )
                    case 2:
                        put(service, name, b"wire")
                        acknowledged.append(name)
                assert not over, "a write of an erased tenant was acknowledged"
            except UnknownTenant:
                return
            except BaseException as error:
                errors.append(error)
                return

    threads = [threading.Thread(target=enroll, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    ready.wait()
    erasure = store.tenant_erasures.erase("default", batch=3)
    done.set()
    for thread in threads:
        thread.join()
    assert errors == []
    assert erasure.erased
    assert nothing_is_left(store, tenants=1)
    receipts = count_subject_receipts(store)
    enrolled = len({*acknowledged, *(() if tenant_goes_first else (f"s{i}" for i in range(40)))})
    # Everybody who was ever enrolled was erased alone, or with the tenant.
    assert counted(erasure.receipt)["subjects"] + receipts >= enrolled
    assert store.audit_log.verify().intact
    service.close()


def count_subject_receipts(store: TemplateStore) -> int:
    lines = store.audit_log.lines()
    return sum(line.action == "erase" and line.outcome == "erased" for line in lines)


def test_an_enrollment_under_way_goes_with_the_tenant(
    store: TemplateStore, database_url: str, key_file: Path, slow_sealing: SlowSealing
) -> None:
    """It found the tenant, and has not committed: no query can see it yet."""
    service = TemplateStore(database_url, MasterKeyring.load(key_file))
    service.signer.pseudonym("default", "-")
    service.audit_log.prepare()
    with ThreadPoolExecutor(2) as threads:
        writing = threads.submit(put, service, "ada", b"wire")
        assert slow_sealing.sealed.wait(PATIENCE_S)
        erasing = threads.submit(store.tenant_erasures.erase, "default")
        early = wait([erasing], timeout=0.5).done
        slow_sealing.go_on.set()
        assert writing.result().created
        erasure = erasing.result()
    assert not early
    assert counted(erasure.receipt)["subjects"] == 1
    assert nothing_is_left(store, tenants=1)
    service.close()


def test_of_two_that_erase_at_once_one_does(
    store: TemplateStore, database_url: str, key_file: Path
) -> None:
    other = TemplateStore(database_url, MasterKeyring.load(key_file))
    everything = fill(store, "default", subjects=12)
    start = threading.Barrier(4)

    def erase(each: TemplateStore) -> TenantErasure:
        start.wait()
        return each.tenant_erasures.erase("default", batch=2)

    with ThreadPoolExecutor(4) as threads:
        running = [threads.submit(erase, each) for each in (store, other, store, other)]
        erasures = [each.result() for each in running]
    assert sum(each.erased for each in erasures) == 1
    assert len({each.receipt for each in erasures}) == 1
    assert counted(erasures[0].receipt) == everything
    assert nothing_is_left(store, tenants=1)
    other.close()


def test_every_table_of_a_tenant_is_known() -> None:
    """A table that is added with rows of a tenant must be added to its erasure as well."""
    of_tenant = {"tenants"}
    while (
        more := {
            table.name
            for table in Base.metadata.tables.values()
            if {key.column.table.name for key in table.foreign_keys} & of_tenant
        }
        - of_tenant
    ):
        of_tenant |= more
    assert of_tenant == {table.__tablename__ for table in OF_A_TENANT}
    # The rest name a tenant at most by its name: receipts and the audit log, which stay.
    columns = {
        table.name
        for table in Base.metadata.tables.values()
        if any(column.name in ("tenant_id", "subject_pk", "api_key_id") for column in table.columns)
    }
    assert columns == of_tenant - {"tenants"}


def test_sqlite_files_keep_nothing_of_an_erased_tenant(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    url = f"sqlite:///{folder / 'veilface.db'}"
    store = TemplateStore(url, keyring)
    store.upgrade()
    for tenant in ("default", "other"):
        store.tenants.create(tenant)
    generator = random.Random(9)
    for number in range(12):
        put(store, f"subject-{number:04}", generator.randbytes(9_000))
    key = store.api_keys.create("default", [Right.VERIFY], label="a label to look for").key
    put(store, "their-subject", generator.randbytes(9_000), tenant="other")
    database = Database(url)

    def secrets(connection: sa.Connection) -> list[bytes]:
        tenant_id = store.tenants.get("default").id
        queries = [
            sa.select(TemplateRow.ciphertext)
            .join(SubjectRow, SubjectRow.id == TemplateRow.subject_pk)
            .where(SubjectRow.tenant_id == tenant_id),
            sa.select(SubjectRow.wrapped_key).where(SubjectRow.tenant_id == tenant_id),
            sa.select(RotationKeyRow.wrapped_key).where(RotationKeyRow.tenant_id == tenant_id),
            sa.select(ApiKeyRow.token_hash).where(ApiKeyRow.tenant_id == tenant_id),
        ]
        blobs = [blob for query in queries for blob in connection.execute(query).scalars()]
        # The first bytes of a sealed blob name its master key, which others share.
        return [piece for blob in blobs for piece in pieces(blob[9:])]

    wanted = database.read(secrets)
    wanted += [f"subject-{number:04}".encode() for number in range(12)]
    wanted.append(key.label.encode())
    assert max(found(folder, wanted).values()) >= 0.9 * len(wanted)
    assert store.tenant_erasures.erase("default", batch=5).log_purged
    assert found(folder, wanted) == {}
    assert (folder / "veilface.db-wal").stat().st_size == 0
    assert store.subjects.get("other", "their-subject") is not None
    database.close()
    store.close()


def test_postgresql_keeps_no_row_after_compacting(
    postgres_url: str, keyring: MasterKeyring
) -> None:
    """What the documentation says of VACUUM: dead rows are in the tables' files until then."""
    store = TemplateStore(postgres_url, keyring)
    store.upgrade()
    store.tenants.create("default")
    fill(store, "default")
    tables = ["subjects", "templates", "rotation_keys", "api_keys", "used_nonces"]
    tables.append("failed_attempts")

    def sizes(connection: sa.Connection) -> list[int]:
        query = sa.select(*(sa.func.pg_relation_size(table) for table in tables))
        return list(connection.execute(query).one())

    store.tenant_erasures.erase("default")
    assert min(store.database.read(sizes)) > 0
    compact_until(store, lambda: set(store.database.read(sizes)) == {0})
    store.close()
