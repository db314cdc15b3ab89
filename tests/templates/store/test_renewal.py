"""Secrets after a theft: what a thief of database and master key can still do, and who notices."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store import By, Entry, Right, TemplateStore, verify_receipt
from templates.store.audit_chain import Anchor, head_mac, line_hash
from templates.store.audit_log import BrokenAuditLog
from templates.store.authenticity import row_mac
from templates.store.database import Database
from templates.store.deployment import PROOF_PURPOSE
from templates.store.receipts import ReceiptKey, sign_claims, verify_under
from templates.store.record_check import ACTOR_NEVER_CREATED, COUNT_VANISHED
from templates.store.renewal import KEPT, Renewed
from templates.store.schema import (
    ApiKeyRow,
    AuditHeadRow,
    AuditRow,
    FailedAttemptsRow,
    ReceiptRow,
    SecretRow,
)
from templates.store.secret import Secret, SecretName
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import Clock, put
from tests.templates.store.test_attempts import attempt
from tests.templates.store.test_audit_log import SQLITE_TRIGGERS

BY = By("operator:test")


@dataclass(frozen=True)
class Loot:
    """What a thief of the database and its master key has opened."""

    keyring: MasterKeyring
    secrets: dict[SecretName, Secret]

    @property
    def chain_key(self) -> bytes:
        return self.secrets[SecretName.CHAIN].value


@dataclass(frozen=True)
class Deployment:
    """A store that its operator uses, a worker that knew every secret before, and the thief."""

    store: TemplateStore
    worker: TemplateStore
    loot: Loot
    key_file: Path

    def renew(self) -> Renewed:
        """What the command does to the database."""
        current = MasterKeyring.add_current(self.key_file)
        self.store.wrapped_keys.rewrap()
        renewed = self.store.renewal.renew(by=BY)
        MasterKeyring.drop_retired(self.key_file, keep=current)
        return renewed

    def run(self, *statements: sa.Executable) -> None:
        """Write what somebody writes who has the database only."""

        def work(connection: sa.Connection) -> None:
            for statement in statements:
                connection.execute(statement)

        database = Database(self.store.database.url.render_as_string(hide_password=False))
        database.write(work)
        database.close()


@pytest.fixture
def deployment(
    store: TemplateStore, database_url: str, key_file: Path, clock: Clock
) -> Iterator[Deployment]:
    secrets = {name: store.secrets.get(name) for name in SecretName}
    worker = TemplateStore(database_url, MasterKeyring.load(key_file), clock=clock)
    for name in SecretName:
        worker.secrets.get(name)
    frozen = key_file.with_name("stolen.key")
    frozen.write_bytes(key_file.read_bytes())
    frozen.chmod(0o600)
    loot = Loot(MasterKeyring.load(frozen), secrets)
    yield Deployment(store, worker, loot, key_file)
    worker.close()


def problems(store: TemplateStore) -> set[tuple[str, str]]:
    """What contradicts the log, but for the key of ``attempt``, which nobody created."""
    return {
        (problem.what, problem.about)
        for problem in store.check_records()
        if problem.what != ACTOR_NEVER_CREATED
    }


def test_every_secret_is_drawn_anew_under_the_new_master_key(deployment: Deployment) -> None:
    store = deployment.store
    # What depends on a secret must be brought forward: see the table of templates.store.renewal.
    # Extend it, the drill, and this list with a new one.
    assert {str(name) for name in SecretName} == {
        "audit-chain",
        "pseudonym",
        "receipt-signing",
        "export",
        "stand-ins",
        "lifts",
    }
    assert not store.renewal.is_done()
    renewed = deployment.renew()
    assert set(renewed.names) == set(SecretName) - KEPT
    assert store.renewal.is_done()
    assert store.renewal.last() == renewed.at
    store.wrapped_keys.rewrap()
    assert store.renewal.is_done()
    deployment.worker.audit_log.head()  # it looks at the database
    for name, stolen in deployment.loot.secrets.items():
        fresh = deployment.worker.secrets.get(name)
        assert fresh == store.secrets.get(name)
        if name in KEPT:
            assert fresh == stolen
            continue
        assert fresh.value != stolen.value
        assert [before.value for before in fresh.retired] == [stolen.value]
        assert stolen.value.hex() not in repr(fresh)
    query = sa.select(SecretRow.name, SecretRow.wrapped_value)
    rows = store.database.read(lambda connection: connection.execute(query).all())
    assert len(rows) == len(SecretName)
    for name, wrapped in rows:
        with pytest.raises(SealError):
            deployment.loot.keyring.open(wrapped, purpose="store-secret", bound_to=[name])


def test_a_thief_does_not_pretend_that_the_secrets_were_renewed(
    deployment: Deployment, clock: Clock
) -> None:
    """Also not between the new master key and the renewal, with write access to the database."""
    store, loot = deployment.store, deployment.loot
    current = MasterKeyring.add_current(deployment.key_file)

    def under_the_stolen_key(value: bytes) -> bytes:
        return loot.keyring.seal(b"", purpose=PROOF_PURPOSE, bound_to=["audit-chain", value])

    def relabelled(value: bytes) -> bytes:
        proof = under_the_stolen_key(value)
        return proof[:1] + bytes.fromhex(current) + proof[9:]

    for prove in (lambda _: None, under_the_stolen_key, relabelled):
        made_up = loot.secrets[SecretName.CHAIN].renewed(at=clock(), line=0, prove=prove)
        sealed = loot.keyring.seal(
            made_up.to_bytes(), purpose="store-secret", bound_to=["audit-chain"]
        )
        row = sa.update(SecretRow).where(SecretRow.name == "audit-chain")
        deployment.run(row.values(wrapped_value=sealed, wrapping_key=sealed_key_id(sealed)))
        assert not deployment.worker.renewal.is_done()
        store.wrapped_keys.rewrap()
        assert not deployment.worker.renewal.is_done()


def test_a_secret_that_this_program_does_not_know_is_not_passed_over(
    deployment: Deployment, clock: Clock
) -> None:
    later = {"name": "of-a-later-version", "wrapped_value": b"x", "wrapping_key": "x"}
    deployment.run(sa.insert(SecretRow).values(**later, created_at=clock()))
    with pytest.raises(StoreError, match="of-a-later-version"):
        deployment.store.renewal.renew()
    assert deployment.store.audit_log.verify().lines == 0


def test_the_chain_is_handed_over(deployment: Deployment) -> None:
    store, worker = deployment.store, deployment.worker
    for number in range(3):
        store.audit_log.record(Entry("test", f"n{number}", BY))
    early = store.audit_log.head()
    first = deployment.renew()
    assert (first.ended, first.anchor.sequence) == (4, 5)
    worker.audit_log.record(Entry("test", "by-a-worker", BY))
    second = deployment.renew()
    assert second.ended == 7
    store.audit_log.record(Entry("test", "later", BY))
    for log in (store.audit_log, worker.audit_log):
        for anchor in (None, early, first.anchor, second.anchor):
            verification = log.verify(anchor=anchor, batch=2)
            assert (verification.intact, verification.lines) == (True, 9), anchor
    hand_over = [(line.action, line.outcome) for line in store.audit_log.lines(after=3)][:2]
    assert hand_over == [("secrets-renew", "retired"), ("secrets-renew", "renewed")]


def forged(
    loot: Loot, sequence: int, previous: bytes, **columns: Any
) -> tuple[dict[str, Any], Anchor]:
    """A line with a hash under the stolen key, and itself as a head."""
    line = {
        "sequence": sequence,
        "tenant": "default",
        "actor": "operator:thief",
        "action": "test",
        "pseudonym": None,
        "outcome": "forged",
        "request_id": None,
        "detail": None,
        "nonce": None,
        "previous_hash": previous,
        **columns,
    }
    line["hash"] = line_hash(loot.chain_key, line)
    return line, Anchor(sequence, line["hash"])


def test_a_line_under_the_stolen_key_does_not_pass(deployment: Deployment, clock: Clock) -> None:
    store, loot = deployment.store, deployment.loot
    store.audit_log.record(Entry("test", "before", BY))
    anchor = deployment.renew().anchor
    line, head = forged(loot, anchor.sequence + 1, anchor.hash, at=clock())
    mac = head_mac(loot.chain_key, head)
    moved = sa.update(AuditHeadRow).values(sequence=head.sequence, hash=head.hash, mac=mac)
    deployment.run(sa.insert(AuditRow).values(**line), moved)
    verification = store.audit_log.verify()
    assert {problem.what for problem in verification.problems} == {
        "altered",
        "head does not match",
    }
    with pytest.raises(BrokenAuditLog):
        deployment.worker.audit_log.record(Entry("test", "after", BY))


def test_lines_of_before_cannot_be_written_again_with_the_stolen_key(
    deployment: Deployment,
) -> None:
    store, loot = deployment.store, deployment.loot
    for _ in range(2):
        store.audit_log.record(Entry("test", "before", BY))
    ended = deployment.renew().ended
    assert store.audit_log.verify().intact
    # The whole time of the old key, true in itself: only the new key's first line tells.
    without_triggers = (
        (f"DROP TRIGGER {name}" for name in SQLITE_TRIGGERS)
        if store.database.is_sqlite
        else ("ALTER TABLE audit_log DISABLE TRIGGER USER",)
    )
    deployment.run(*map(sa.text, without_triggers))
    previous = bytes(32)
    for line in list(store.audit_log.lines())[:ended]:
        columns = {"at": line.at, "action": line.action, "actor": line.actor}
        values, head = forged(loot, line.sequence, previous, **columns)
        previous = head.hash
        deployment.run(sa.update(AuditRow).where(AuditRow.sequence == line.sequence).values(values))
    (problem,) = store.audit_log.verify().problems
    assert (problem.sequence, problem.what) == (ended + 1, "out of order")


def test_a_made_up_api_key_is_none_in_a_worker_that_knew_the_stolen_secret(
    deployment: Deployment, clock: Clock
) -> None:
    store, worker, loot = deployment.store, deployment.worker, deployment.loot
    made = store.api_keys.create("default", [Right.VERIFY])
    assert worker.api_keys.verify(made.token) is not None
    deployment.renew()
    row_key = store.audit_log.row_key_of(loot.chain_key)
    query = sa.select(ApiKeyRow.__table__).where(ApiKeyRow.prefix == made.key.prefix)
    row = store.database.read(lambda connection: connection.execute(query).one())._asdict()
    widened = {**row, "rights": "admin,erase"}
    widened["mac"] = row_mac(row_key, ApiKeyRow, {**widened, "tenant": "default"})
    deployment.run(sa.update(ApiKeyRow).values(rights=widened["rights"], mac=widened["mac"]))
    assert worker.api_keys.verify(made.token) is None
    deployment.run(sa.update(ApiKeyRow).values(rights=row["rights"], mac=row["mac"]))
    assert worker.api_keys.verify(made.token) is not None


def test_a_row_that_was_not_good_is_not_vouched_for(deployment: Deployment) -> None:
    store, loot = deployment.store, deployment.loot
    good, altered, unknown = (
        store.api_keys.create("default", [Right.VERIFY], label=label)
        for label in ("good", "altered", "unknown")
    )
    # The thief signs one row with the stolen key, but the log has no line that it was created.
    row_key = store.audit_log.row_key_of(loot.chain_key)
    query = sa.select(ApiKeyRow.__table__).where(ApiKeyRow.prefix == unknown.key.prefix)
    row = store.database.read(lambda connection: connection.execute(query).one())._asdict()
    row |= {"prefix": "0123456789ab", "id": "0" * 32, "line": 0}
    row["mac"] = row_mac(row_key, ApiKeyRow, {**row, "tenant": "default"})
    widened = sa.update(ApiKeyRow).where(ApiKeyRow.prefix == altered.key.prefix)
    deployment.run(sa.insert(ApiKeyRow).values(row), widened.values(rights="admin"))
    refused = deployment.renew().refused
    assert refused == ("0123456789ab",)
    authentic = {key.prefix: key.authentic for key in store.api_keys.all()}
    assert authentic == {
        good.key.prefix: True,
        unknown.key.prefix: True,
        altered.key.prefix: False,
        "0123456789ab": False,
    }


def test_counts_of_failures_go_on(deployment: Deployment, clock: Clock) -> None:
    store, worker = deployment.store, deployment.worker
    put(store, "ada", b"wire")
    for subject in ("ada", "ada", "ada", "nobody"):
        assert attempt(store, subject, known=subject == "ada") == "reject"
    old = store.signer.pseudonym("default", "ada")
    for _ in range(2):
        deployment.renew()
    assert worker.attempts.status("default", "ada").consecutive == 3
    assert worker.signer.pseudonym("default", "ada") != old
    assert worker.signer.pseudonyms("default", "ada")[-1] == old
    assert problems(store) == set()
    assert [attempt(worker) for _ in range(3)] == ["reject", "reject", "locked 30"]
    assert store.attempts.status("default", "nobody").consecutive == 1

    # Removed, the count is taken from the log, whose lines name old and new pseudonyms.
    deployment.run(sa.delete(FailedAttemptsRow))
    assert worker.attempts.status("default", "ada").consecutive == 5
    assert attempt(worker) == "locked 30"
    newest = worker.signer.pseudonym("default", "ada")
    oldest = worker.signer.pseudonyms("default", "nobody")[-1]
    assert problems(store) == {(COUNT_VANISHED, newest), (COUNT_VANISHED, oldest)}


def test_an_accept_and_an_erasure_after_it_end_a_count_of_before(
    deployment: Deployment,
) -> None:
    store = deployment.store
    for subject in ("ada", "bob"):
        put(store, subject, b"wire")
        assert attempt(store, subject) == "reject"
    deployment.renew()
    assert attempt(store, "ada", accepted=True) == "accept"
    store.erasures.erase("default", "bob")
    assert store.attempts.status("default", "ada").consecutive == 0
    assert store.attempts.status("default", "bob") is None
    assert problems(store) == set()


def test_receipts_of_before_verify_and_are_signed_again(
    deployment: Deployment, clock: Clock
) -> None:
    store, worker = deployment.store, deployment.worker
    put(store, "ada", b"wire")
    before = store.erasures.erase("default", "ada").receipt
    of_tenant = store.tenant_erasures.erase("other").receipt
    clock.pass_by(hours=1)
    renewed = deployment.renew()
    assert renewed.receipts == 2
    clock.pass_by(hours=1)
    again = worker.erasures.erase("default", "ada")
    assert not again.erased
    assert again.receipt == store.erasures.receipt("default", "ada")
    claims = verify_receipt(again.receipt, store.signer.public_key())
    assert {**claims, "signing_key": ""} == {**before.claims, "signing_key": ""}
    tenants = store.tenant_erasures.receipt("other")
    assert verify_receipt(tenants, store.signer.public_key())["tenant"] == "other"
    # An erased tenant that is made anew goes on with the epochs.
    assert store.tenants.create("other").rotation_epoch == 2

    current, retired = store.signer.keys()
    assert (current.retired_at, retired.retired_at) == (None, renewed.at)
    for receipt in (before, of_tenant):
        assert verify_under(receipt, store.signer.keys()) == (receipt.claims, retired)
    assert verify_under(again.receipt, store.signer.keys())[1] == current
    stolen = deployment.loot.secrets[SecretName.RECEIPT].value
    for late in (clock().isoformat(), "2026-13-01", 5, None):
        made_up = sign_claims({**before.claims, "erased_at": late}, stolen)
        verify_receipt(made_up, retired.public_key)  # the signature is true
        with pytest.raises(StoreError, match="retired"):
            verify_under(made_up, store.signer.keys())
        with pytest.raises(StoreError, match="signature"):
            verify_under(made_up, [ReceiptKey(current.public_key)])


def test_a_made_up_receipt_in_the_database_is_not_signed_again(deployment: Deployment) -> None:
    store = deployment.store
    receipt = store.erasures.erase("default", "ada").receipt
    deployment.run(sa.update(ReceiptRow).values(body=receipt.body.replace("false", "true")))
    assert deployment.renew().receipts == 0


def test_tenants_are_left_until_their_rotation_is_renewed(deployment: Deployment) -> None:
    store = deployment.store
    deployment.renew()
    assert store.renewal.tenants_left() == ("default", "other")
    store.rerotation.begin("default", by=BY)
    assert store.renewal.tenants_left() == ("other",)


def test_workers_go_on_while_secrets_are_renewed(
    deployment: Deployment, database_url: str, clock: Clock
) -> None:
    """Every request that runs beside a renewal is answered as if it ran before or after it."""
    store = deployment.store
    token = store.api_keys.create("default", [Right.VERIFY]).token
    put(store, "ada", b"wire")
    stop, errors, done = threading.Event(), list[BaseException](), list[int]()

    def work() -> None:
        worker = TemplateStore(
            database_url, MasterKeyring.load(deployment.key_file), clock=clock, timeout=PATIENCE_S
        )
        try:
            count = 0
            while not stop.is_set() and count < 500:
                assert worker.api_keys.verify(token) is not None
                assert attempt(worker, "ada", accepted=True) == "accept"
                worker.audit_log.record(Entry("test", "beside", BY))
                assert worker.tenants.get("default").name == "default"
                count += 1
            done.append(count)
        except BaseException as error:
            errors.append(error)
        finally:
            worker.close()

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for _ in range(4):
        deployment.renew()
    stop.set()
    for thread in threads:
        thread.join()
    assert errors == []
    assert len(done) == 3
    assert store.audit_log.verify().intact
    assert problems(store) == set()


def test_a_secret_reads_what_it_wrote(clock: Clock) -> None:
    secret = Secret(bytes(range(32)))
    assert secret.to_bytes() == secret.value
    assert secret.since(1) == ()
    for line in (3, 9):
        secret = secret.renewed(at=clock() + timedelta(seconds=line), line=line, prove=lambda v: v)
    assert Secret.from_bytes(secret.to_bytes()) == secret
    assert secret.since(2) == (secret.retired[1].value, secret.value)
    assert secret.since(3) == secret.since(2)
    assert secret.since(4) == (secret.value,)
    assert secret.since(10) == ()
