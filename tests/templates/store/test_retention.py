import random
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import By, Receipt, Retention, TemplateStore, verify_receipt
from templates.store.database import Database
from templates.store.erasure import Erasures
from templates.store.schema import ReceiptRow, SubjectRow, TemplateRow
from tests.templates.store.conftest import CONTRACT, Clock, put
from tests.templates.store.test_attempts import Says, attempt, decide
from tests.templates.store.test_erasure import count, found, pieces

DAY = timedelta(days=1)


def use(store: TemplateStore, subject_id: str) -> None:
    assert attempt(store, subject_id, accepted=True) == "accept"


def names(store: TemplateStore, tenant: str = "default") -> list[str]:
    return [each.subject_id for each in store.subjects.list(tenant).records]


@pytest.fixture
def five(store: TemplateStore, clock: Clock) -> TemplateStore:
    """Subjects that were enrolled and used at different times; now is day 100.

    ========  ========  ====
    subject   enrolled  used
    ========  ========  ====
    forgot    0         —
    lapsed    0         30
    regular   0         95
    renewed   95        30
    young     95        —
    ========  ========  ====
    """
    for name in ("forgot", "lapsed", "regular", "renewed"):
        put(store, name, b"wire")
    clock.pass_by(days=30)
    use(store, "lapsed")
    use(store, "renewed")
    clock.pass_by(days=65)
    use(store, "regular")
    put(store, "renewed", b"wire")
    put(store, "young", b"wire")
    clock.pass_by(days=5)
    return store


@pytest.mark.parametrize(
    ("max_age", "max_disuse", "kept"),
    [
        (None, None, ["forgot", "lapsed", "regular", "renewed", "young"]),
        (50, None, ["renewed", "young"]),
        (None, 50, ["regular", "renewed", "young"]),
        (None, 80, ["lapsed", "regular", "renewed", "young"]),
        (50, 200, ["renewed", "young"]),
        (200, 50, ["regular", "renewed", "young"]),
        (4, 4, []),
        (None, 4, []),
        (101, 101, ["forgot", "lapsed", "regular", "renewed", "young"]),
    ],
)
def test_who_is_due(
    five: TemplateStore, max_age: int | None, max_disuse: int | None, kept: list[str]
) -> None:
    keep = Retention(
        None if max_age is None else max_age * DAY, None if max_disuse is None else max_disuse * DAY
    )
    assert five.retention.due(keep) == 5 - len(kept)
    assert five.retention.erase_expired(keep, batch=2) == 5 - len(kept)
    assert names(five) == kept
    assert five.retention.due(keep) == 0
    assert five.retention.erase_expired(keep) == 0


def test_the_limit_itself_is_not_over_it(store: TemplateStore, clock: Clock) -> None:
    put(store, "ada", b"wire")
    clock.pass_by(days=10)
    assert (
        store.retention.due(Retention(10 * DAY))
        == store.retention.due(Retention(None, 10 * DAY))
        == 0
    )
    clock.pass_by(microseconds=1)
    assert (
        store.retention.due(Retention(10 * DAY))
        == store.retention.due(Retention(None, 10 * DAY))
        == 1
    )


def test_it_is_the_ordinary_erasure(store: TemplateStore, clock: Clock) -> None:
    put(store, "ada", b"wire")
    put(store, "ada", b"wire", tenant="other")
    clock.pass_by(days=10)
    assert store.retention.erase_expired(Retention(5 * DAY)) == 2
    for tenant in ("default", "other"):
        receipt = store.erasures.receipt(tenant, "ada")
        assert receipt is not None
        claims = verify_receipt(receipt, store.signer.public_key())
        assert (claims["tenant"], claims["held"], claims["contract_id"]) == (tenant, True, CONTRACT)
    lines = [line for line in store.audit_log.lines() if line.action == "erase"]
    assert [(line.actor, line.outcome) for line in lines] == [("retention", "erased")] * 2
    assert {line.pseudonym for line in lines} == {
        store.signer.pseudonym(tenant, "ada") for tenant in ("default", "other")
    }
    assert store.audit_log.verify().intact


def test_another_actor_may_ask_for_it(store: TemplateStore, clock: Clock) -> None:
    put(store, "ada", b"wire")
    clock.pass_by(days=10)
    store.retention.erase_expired(Retention(DAY), by=By("operator:kim"))
    assert [line.actor for line in store.audit_log.lines()][-1] == "operator:kim"


@pytest.mark.parametrize("value", [timedelta(0), -DAY, 36_501 * DAY, timedelta.max])
def test_a_senseless_retention_is_refused(value: timedelta) -> None:
    for arguments in ((value, None), (None, value), (DAY, value)):
        with pytest.raises(StoreError, match="36500 days"):
            Retention(*arguments)


def test_many_of_one_moment_are_listed_in_steps(store: TemplateStore, clock: Clock) -> None:
    for number in range(11):
        put(store, f"s{number}", b"wire")
    clock.pass_by(days=10)
    put(store, "young", b"wire")
    assert store.retention.erase_expired(Retention(5 * DAY), batch=3) == 11
    assert names(store) == ["young"]


def after_listing(monkeypatch: pytest.MonkeyPatch, action: Callable[[], object]) -> None:
    """Do something once, when the list of who is due was read and nobody is erased yet."""
    erase_if, done = Erasures.erase_if, threading.Event()

    def and_then(*arguments: Any, **options: Any) -> Receipt | None:
        if not done.is_set():
            done.set()
            action()
        return erase_if(*arguments, **options)

    monkeypatch.setattr(Erasures, "erase_if", and_then)


@pytest.mark.parametrize("change", ["enrolled again", "used", "erased", "made anew", "gone"])
def test_who_changed_since_the_list_was_read_is_asked_again(
    store: TemplateStore, clock: Clock, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    tenant = "acme" if change == "gone" else "default"
    store.tenants.create(tenant)
    put(store, "ada", b"wire", tenant=tenant)
    put(store, "eve", b"wire")
    clock.pass_by(days=10)

    def act() -> None:
        match change:
            case "enrolled again":
                put(store, "ada", b"wire")
            case "used":
                use(store, "ada")
            case "erased":
                store.erasures.erase("default", "ada")
            case "made anew":
                store.erasures.erase("default", "ada")
                put(store, "ada", b"wire")
            case "gone":
                store.erasures.erase_tenant(tenant)

    after_listing(monkeypatch, act)
    assert store.retention.erase_expired(Retention(None, 5 * DAY)) == 1
    survives = change in ("enrolled again", "used", "made anew")
    assert names(store) == (["ada"] if survives else [])
    by_retention = [line for line in store.audit_log.lines() if line.actor == "retention"]
    assert [line.pseudonym for line in by_retention] == [store.signer.pseudonym("default", "eve")]


def test_of_a_use_and_an_erasure_at_once_one_comes_first(
    store: TemplateStore, database_url: str, key_file: Path, clock: Clock
) -> None:
    """A subject with an accept is still enrolled afterwards."""
    service = TemplateStore(database_url, MasterKeyring.load(key_file), clock=clock)
    people = [f"s{number:02}" for number in range(30)]
    for name in people:
        put(store, name, b"wire")
    clock.pass_by(days=10)
    accepted: set[str] = set()
    start = threading.Barrier(3)

    def verify(mine: list[str]) -> None:
        start.wait()
        for name in mine:
            # A subject that is gone by the record is decided on again, and rejected.
            if decide(service, lambda each: Says(each.template is not None), subject=name).accepted:
                accepted.add(name)

    def erase() -> int:
        start.wait()
        return store.retention.erase_expired(Retention(None, 5 * DAY), batch=4)

    shuffled = random.Random(7).sample(people, len(people))
    with ThreadPoolExecutor(3) as threads:
        erasing = threads.submit(erase)
        for each in [threads.submit(verify, shuffled[half::2]) for half in (0, 1)]:
            each.result()
        erased = erasing.result()
    assert set(names(store)) == accepted
    assert erased == len(people) - len(accepted)
    service.close()


def test_workers_that_erase_at_once_erase_each_subject_once(
    store: TemplateStore, database_url: str, key_file: Path, clock: Clock
) -> None:
    other = TemplateStore(database_url, MasterKeyring.load(key_file), clock=clock)
    for number in range(25):
        put(store, f"s{number}", b"wire")
    clock.pass_by(days=10)
    with ThreadPoolExecutor(4) as threads:
        runs = [
            threads.submit(each.retention.erase_expired, Retention(DAY), batch=4)
            for each in (store, other, store, other)
        ]
        assert sum(run.result() for run in runs) == 25
    assert count(store.database, ReceiptRow) == 25
    assert count(store.database, TemplateRow) == 0
    assert store.audit_log.verify().intact
    other.close()


def test_sqlite_files_keep_nothing_of_who_was_erased(
    tmp_path: Path, keyring: MasterKeyring, clock: Clock
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    url = f"sqlite:///{folder / 'veilface.db'}"
    store = TemplateStore(url, keyring, clock=clock)
    store.upgrade()
    store.tenants.create("default")
    generator = random.Random(8)
    for number in range(10):
        put(store, f"subject-{number:04}", generator.randbytes(9_000))
    clock.pass_by(days=10)
    put(store, "subject-0003", generator.randbytes(9_000))
    database = Database(url)
    rows = database.read(
        lambda each: each.execute(
            sa.select(SubjectRow.subject_id, SubjectRow.wrapped_key, TemplateRow.ciphertext).join(
                TemplateRow, TemplateRow.subject_pk == SubjectRow.id
            )
        ).all()
    )
    gone = [row for row in rows if row.subject_id != "subject-0003"]
    wanted = [piece for row in gone for piece in pieces(row.ciphertext)]
    wanted += [piece for row in gone for piece in pieces(row.wrapped_key[9:])]
    wanted += [row.subject_id.encode() for row in gone]
    assert max(found(folder, wanted).values()) >= 0.9 * len(wanted)
    assert store.retention.erase_expired(Retention(5 * DAY), batch=4) == 9
    assert found(folder, wanted) == {}
    assert (folder / "veilface.db-wal").stat().st_size == 0
    assert store.subjects.get("default", "subject-0003") is not None
    database.close()
    store.close()
