"""Templates that the subject's holder keeps: what the store keeps of them, and when they open."""

from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import (
    Attempt,
    By,
    Retention,
    Storage,
    TemplateNotStored,
    TemplateStore,
)
from templates.store.schema import Base
from tests.templates.store.conftest import CONTRACT, Clock, put
from tests.templates.store.test_erasure import found, pieces
from tests.templates.store.test_rerotation import People, epochs

WIRE = bytes(range(256)) * 8


def hold(store: TemplateStore, subject: str = "ada", **more: str) -> bytes:
    """Enroll a subject whose template its holder keeps; return that template."""
    stored = put(store, subject, WIRE, storage=Storage.HOLDER, **more)
    assert stored.held_template is not None
    return stored.held_template


def opens(store: TemplateStore, held_template: bytes, subject: str = "ada") -> bool:
    """Whether a verification would be decided by the template that is sent."""
    attempt = store.attempts.begin(
        "default", subject, contract_id=CONTRACT, held_template=held_template
    )
    assert attempt.template is None or attempt.template.wire == WIRE
    return attempt.template is not None


def everything(store: TemplateStore) -> bytes:
    """All values of all tables."""
    rows: list[object] = []
    for table in Base.metadata.sorted_tables:
        query = sa.select(table)
        rows += store.database.read(lambda each, query=query: each.execute(query).all())
    values = [value for row in rows for value in row]
    return b"\n".join(v if isinstance(v, bytes) else str(v).encode() for v in values)


def test_the_template_opens_with_what_the_store_kept(store: TemplateStore, tmp_path: Path) -> None:
    held = hold(store)
    record = store.subjects.describe("default", "ada")
    assert record is not None
    assert record.storage is Storage.HOLDER
    opened = store.subjects.get("default", "ada", held_template=held)
    assert opened is not None
    assert (opened.wire, opened.record) == (WIRE, record)
    assert opens(store, held)
    for read in (store.subjects.get, store.subjects.stored_form):
        with pytest.raises(TemplateNotStored, match="the holder of this subject keeps"):
            read("default", "ada")
    assert [line.detail for line in store.audit_log.lines() if line.action == "enroll"] == [
        "holder"
    ]
    assert "held_template" not in repr(put(store, "eve", WIRE, storage=Storage.HOLDER))


def test_the_database_holds_no_byte_of_it(store: TemplateStore, tmp_path: Path) -> None:
    control = put(store, "eve", WIRE)
    assert control.held_template is None
    kept = everything(store)
    held = hold(store)
    # The control: a stored template is there, and would be seen.
    query = sa.text("SELECT ciphertext FROM templates WHERE ciphertext IS NOT NULL")
    stored = store.database.read(lambda each: bytes(each.execute(query).scalar_one()))
    assert all(piece in kept for piece in pieces(stored))
    kept = everything(store)
    assert not any(piece in kept for piece in pieces(held))
    assert not any(piece in kept for piece in pieces(WIRE))
    assert found(tmp_path, pieces(held)) == {}, "nor the file, its log, and what it once held"


def test_no_other_template_opens(store: TemplateStore) -> None:
    held, other = hold(store), hold(store, "eve")
    theirs = hold(store, tenant="other")
    altered = [
        bytes([*held[:at], held[at] ^ 1, *held[at + 1 :]]) for at in (0, 1, 13, 700, len(held) - 1)
    ]
    for wrong in (b"", b"\x01", held[:-1], held + b"\0", WIRE, other, theirs, *altered):
        assert not opens(store, wrong)
    assert opens(store, held)
    # One that nobody waits for is handed on: the caller still owes the work of trying it.
    put(store, "stored", WIRE)
    for subject in ("nobody", "stored"):
        attempt = store.attempts.begin("default", subject, contract_id=CONTRACT, held_template=held)
        assert attempt.untried == held
        assert (attempt.template is None) == (subject == "nobody")


def test_what_ends_an_enrollment_ends_its_template(store: TemplateStore, clock: Clock) -> None:
    first = hold(store)
    second = hold(store)
    assert not opens(store, first)
    assert opens(store, second)
    put(store, "ada", WIRE)
    third = hold(store)
    assert not opens(store, second)
    clock.pass_by(days=2)
    assert store.retention.erase_expired(Retention(max_age=timedelta(days=1))) == 1
    assert not opens(store, third)
    fourth = hold(store)
    receipt = store.erasures.erase("default", "ada").receipt
    assert receipt.held
    assert receipt.claims["contract_id"] == CONTRACT
    counts = {item["item"]: item["count"] for item in receipt.claims["erased"]}
    assert (counts["template"], counts["data_key"], counts["metadata"]) == (0, 1, 1)
    hold(store)
    assert not opens(store, fourth)


def test_a_decision_without_it_is_counted(store: TemplateStore) -> None:
    hold(store)
    record = store.subjects.describe("default", "ada")
    assert record is not None
    attempt = store.attempts.begin("default", "ada", contract_id=CONTRACT)
    assert (attempt.template, attempt.template_id) == (None, record.template_id)
    store.attempts.conclude(
        "default",
        "ada",
        accepted=False,
        template_id=attempt.template_id,
        contract_id=CONTRACT,
        level="fmr-1e-3",
        nonce=None,
        by=By("key:x"),
    )
    status = store.attempts.status("default", "ada")
    assert status is not None
    assert status.consecutive == 1


@dataclass(frozen=True)
class Decided:
    accepted: bool
    level: str = "fmr-1e-3"


def test_a_decision_under_the_lock_has_it_too(store: TemplateStore) -> None:
    held = hold(store)

    def decide(attempt: Attempt) -> Decided:
        return Decided(attempt.template is not None)

    for sent, accepted in ((held, True), (b"another", False)):
        decided = store.attempts.decide_alone(
            "default",
            "ada",
            decide,
            contract_id=CONTRACT,
            nonce=None,
            held_template=sent,
            by=By("key:x"),
        )
        assert decided.accepted is accepted


def test_a_tenant_receipt_counts_what_was_here(store: TemplateStore) -> None:
    hold(store)
    put(store, "eve", WIRE)
    assert store.tenant_erasures.held("default").templates == 1
    receipt = store.tenant_erasures.erase("default").receipt
    counts = {item["item"]: item["count"] for item in receipt.claims["erased"]}
    assert (counts["subjects"], counts["data_keys"], counts["templates"]) == (2, 2, 1)


def test_another_master_key_opens_it_too(
    store: TemplateStore, database_url: str, key_file: Path
) -> None:
    held = hold(store)
    current = MasterKeyring.add_current(key_file)
    store.wrapped_keys.rewrap()
    MasterKeyring.drop_retired(key_file, keep=current)
    fresh = TemplateStore(database_url, MasterKeyring.load(key_file))
    assert opens(fresh, held)
    fresh.close()


def test_a_renewal_of_the_rotations_leaves_it_where_it_is(store: TemplateStore) -> None:
    people = People(store, 2)
    people.enroll("s000")
    contract_id = people.binding.contract_id
    held = hold(store, "s001", contract_id=contract_id)

    def read() -> bytes | None:
        attempt = store.attempts.begin(
            "default", "s001", contract_id=contract_id, held_template=held
        )
        assert attempt.template is not None
        assert attempt.template.record.rotation_epoch == 1
        return attempt.template.wire

    store.rerotation.begin("default")
    assert store.rerotation.move("default", people.binding) == 1
    assert read() == WIRE
    assert list(store.rerotation.subjects_of_old_epochs("default")) == ["s001"]
    with pytest.raises(StoreError, match="whose holders keep theirs"):
        store.rerotation.retire("default")
    assert epochs(store) == [1, 2]
    hold(store, "s001", contract_id=contract_id)
    assert store.rerotation.retire("default") == 1
    assert epochs(store) == [2]


def test_an_altered_data_key_is_no_rejection(store: TemplateStore) -> None:
    """What is wrong with the store must not look like what is wrong with the person."""
    held = hold(store)
    hold(store, "eve")
    theirs = "(SELECT wrapped_key FROM subjects WHERE subject_id = 'eve')"
    statement = f"UPDATE subjects SET wrapped_key = {theirs} WHERE subject_id = 'ada'"
    store.database.write(lambda each: each.exec_driver_sql(statement))
    with pytest.raises(SealError, match="altered, or belongs elsewhere"):
        opens(store, held)
