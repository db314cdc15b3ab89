"""Events for the operator's endpoint: written with what they tell, claimed by one, told again."""

import base64
import hashlib
import hmac
import json
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.keys.sealing import MasterKeyring
from templates.keys.webhook_secret import signatures
from templates.store import By, LockoutPolicy, TemplateStore
from templates.store.outbox import KEPT, LEASE, LONGEST_WAIT, RETRIED, Event
from templates.store.schema import OutboxRow
from templates.store.subjects import EnrollmentConflict, Precondition
from tests.databases import migrate_ahead
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import Clock, put, template_id

SECRETS = (b"s" * 32, b"t" * 32)


@pytest.fixture
def telling(database_url: str, keyring: MasterKeyring, clock: Clock) -> Iterator[TemplateStore]:
    """A store that tells events; the second rejection in a row locks."""
    migrate_ahead(database_url)
    store = TemplateStore(
        database_url, keyring, clock=clock, timeout=PATIENCE_S, tells_events=True,
        lockout=LockoutPolicy(after=2, first_s=30, longest_s=3600, disable_at=3),
    )  # fmt: skip
    store.upgrade()
    store.tenants.create("default")
    yield store
    store.close()


def told(event: Event | None) -> dict:
    assert event is not None
    return json.loads(event.body)


def reject(store: TemplateStore, subject: str) -> None:
    store.attempts.conclude(
        "default",
        subject,
        accepted=False,
        template_id=template_id(store, subject),
        level="high",
        nonce=None,
        by=By("key:test"),
    )


def test_what_happens_to_a_subject_is_told_in_its_order(
    telling: TemplateStore, clock: Clock
) -> None:
    put(telling, "ann", b"1", template_id="a")
    put(telling, "ann", b"2", template_id="b")
    for _ in range(2):
        reject(telling, "ann")
    telling.erasures.erase("default", "ann")
    telling.erasures.erase("default", "ann")  # nobody is there any more: nothing to tell
    with pytest.raises(EnrollmentConflict):
        put(telling, "ann", b"3", precondition=Precondition("b"))
    events = []
    while (event := telling.outbox.claim()) is not None:
        assert telling.outbox.claim() is None, "later ones of the subject wait"
        telling.outbox.taken(event)
        events.append(told(event))
    reject(telling, "nobody")
    reject(telling, "nobody")
    clock.time += timedelta(seconds=30)
    reject(telling, "nobody")
    for disabled in (False, True):
        event = telling.outbox.claim()
        assert told(event)["type"] == "subject.locked_out"
        assert told(event)["data"]["disabled"] is disabled
        telling.outbox.taken(event)
    clock.time -= timedelta(seconds=30)
    about = {"tenant": "default", "subject_id": "ann"}
    until = (clock() + timedelta(seconds=30)).isoformat()
    assert [(event["type"], event["data"]) for event in events] == [
        ("subject.enrolled", {**about, "template_id": "a", "replaced": False}),
        ("subject.enrolled", {**about, "template_id": "b", "replaced": True}),
        ("subject.locked_out", {**about, "until": until, "disabled": False}),
        ("subject.erased", about),
    ]
    assert {event["timestamp"] for event in events} == {clock().isoformat()}


def test_another_subject_does_not_wait(telling: TemplateStore) -> None:
    put(telling, "ann", b"1")
    put(telling, "bob", b"2")
    first, second = telling.outbox.claim(), telling.outbox.claim()
    assert [told(each)["data"]["subject_id"] for each in (first, second)] == ["ann", "bob"]


def test_an_event_is_told_again_until_it_is_taken(telling: TemplateStore, clock: Clock) -> None:
    put(telling, "ann", b"1")
    waits, event = [], telling.outbox.claim()
    for attempt in range(1, 16):
        assert event is not None
        assert event.attempts == attempt
        telling.outbox.postpone(event)
        wait = timedelta(seconds=min(2.0**attempt, LONGEST_WAIT.total_seconds()))
        clock.time += wait - timedelta(seconds=1)
        assert telling.outbox.claim() is None
        clock.time += timedelta(seconds=1)
        again = telling.outbox.claim()
        assert again is not None
        assert (again.event_id, again.body) == (event.event_id, event.body)
        event = again
        waits.append(wait)
    assert waits[0] == timedelta(seconds=2)
    assert waits[-1] == LONGEST_WAIT
    telling.outbox.taken(event)
    assert telling.outbox.waiting() == 0


def test_the_claim_of_a_worker_that_died_lapses(telling: TemplateStore, clock: Clock) -> None:
    put(telling, "ann", b"1")
    lost = telling.outbox.claim()
    assert telling.outbox.claim() is None
    clock.time += LEASE
    again = telling.outbox.claim()
    assert (again.event_id, again.attempts) == (lost.event_id, 2)
    # The first one was alive after all: it does not make the second's claim shorter or longer.
    telling.outbox.postpone(lost)
    assert telling.outbox.claim() is None
    telling.outbox.taken(again)
    put(telling, "bob", b"2")
    telling.outbox.taken(lost)
    assert told(telling.outbox.claim())["data"]["subject_id"] == "bob"


def test_of_workers_that_claim_at_once_each_gets_another(
    telling: TemplateStore, database_url: str, key_file: Path, clock: Clock
) -> None:
    for number in range(12):
        put(telling, f"subject-{number}", b"1")
    others = [
        TemplateStore(database_url, MasterKeyring.load(key_file), clock=clock, tells_events=True)
        for _ in range(3)
    ]
    try:
        with ThreadPoolExecutor(8) as threads:
            outboxes = [[telling, *others][number % 4].outbox for number in range(16)]
            claimed = list(threads.map(lambda outbox: outbox.claim(), outboxes))
        ids = [event.event_id for event in claimed if event is not None]
        assert len(ids) == len(set(ids)) == 12
    finally:
        for store in others:
            store.close()


def alter(store: TemplateStore, sequence: int, **values: object) -> None:
    statement = sa.update(OutboxRow.__table__).where(OutboxRow.sequence == sequence)
    store.database.write(lambda connection: connection.execute(statement.values(**values)))


def rows(store: TemplateStore) -> list[dict]:
    query = sa.select(OutboxRow.__table__).order_by(OutboxRow.sequence)
    return store.database.read(lambda each: [row._asdict() for row in each.execute(query)])


def test_what_somebody_else_wrote_is_dropped(
    telling: TemplateStore, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    telling.tenants.create("other")
    put(telling, "ann", b"1", tenant="other")
    for number in range(7):
        put(telling, f"bob-{number}", b"1")
    (foreign, first, *rest) = rows(telling)
    sealed = bytearray(first["wrapped_body"])
    sealed[-1] ^= 1
    for row, values in zip(
        rest[:5],
        (
            {"wrapped_body": first["wrapped_body"], "wrapping_key": first["wrapping_key"]},
            {"tenant_id": foreign["tenant_id"]},
            {"pseudonym": first["pseudonym"]},
            {"created_at": clock() + timedelta(days=1)},
            {"mac": None},
        ),
        strict=True,
    ):
        alter(telling, row["sequence"], **values)
    alter(telling, first["sequence"], wrapped_body=bytes(sealed))
    told_of = []
    while (event := telling.outbox.claim()) is not None:
        told_of.append(told(event)["data"]["subject_id"])
    assert sorted(told_of) == ["ann", "bob-6"]
    assert telling.outbox.waiting() == 2
    assert caplog.text.count("not authentic") == 6
    assert "bob" not in caplog.text


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("created_at", "'no time'"),
        ("created_at", "x'00'"),
        ("attempts", "'many'"),
        ("attempts", "9223372036854775807"),
        ("wrapped_body", "'text'"),
        ("wrapped_body", "x''"),
        ("event_id", "x'ff'"),
        ("event_id", "1"),
        ("mac", "'text'"),
    ],
)
def test_a_row_that_cannot_be_read_stops_nothing(
    telling: TemplateStore, column: str, value: str
) -> None:
    if not telling.database.is_sqlite:
        pytest.skip("PostgreSQL keeps no such value")
    put(telling, "ann", b"1")
    put(telling, "bob", b"1")
    text = f"UPDATE outbox SET {column} = {value} WHERE sequence = 1"
    telling.database.write(lambda connection: connection.exec_driver_sql(text))
    events = []
    while (event := telling.outbox.claim()) is not None:
        telling.outbox.postpone(event)
        events.append(told(event)["data"]["subject_id"])
    # How often it was sent decides nothing: a wrong count of it is no reason to lose it.
    assert events == (["ann", "bob"] if value.isdecimal() and column == "attempts" else ["bob"])


def test_an_event_is_given_up_after_days_but_not_untried(
    telling: TemplateStore, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    put(telling, "ann", b"1")
    event = telling.outbox.claim()
    clock.time += RETRIED - timedelta(seconds=1)
    telling.outbox.postpone(event)
    assert telling.outbox.waiting() == 1
    clock.time += LONGEST_WAIT
    telling.purge()
    again = telling.outbox.claim()
    assert (again.event_id, again.attempts) == (event.event_id, 2)
    assert "given up" not in caplog.text
    telling.outbox.postpone(again)
    assert telling.outbox.waiting() == 0
    assert "given up" in caplog.text
    assert "ann" not in caplog.text


def test_an_old_event_that_is_put_back_is_not_sent(telling: TemplateStore, clock: Clock) -> None:
    put(telling, "ann", b"1")
    (row,) = rows(telling)
    telling.outbox.taken(telling.outbox.claim())
    for age, is_sent in ((KEPT - timedelta(seconds=1), True), (KEPT, False)):
        clock.time = row["created_at"] + age
        # With a younger time it is not authentic; so the service sees how old it is.
        put_back = sa.insert(OutboxRow).values(**row)
        telling.database.write(lambda connection, what=put_back: connection.execute(what))
        event = telling.outbox.claim()
        assert (event is not None) is is_sent
        if event is not None:
            telling.outbox.taken(event)
    assert telling.outbox.waiting() == 0


def test_events_expire_also_where_none_are_told_any_more(
    telling: TemplateStore, database_url: str, key_file: Path, clock: Clock
) -> None:
    put(telling, "ann", b"1")
    silent = TemplateStore(database_url, MasterKeyring.load(key_file), clock=clock)
    try:
        clock.time += KEPT - timedelta(seconds=1)
        silent.purge()
        assert silent.outbox.waiting() == 1
        clock.time += timedelta(seconds=1)
        silent.purge()
        assert silent.outbox.waiting() == 0
    finally:
        silent.close()


def test_no_column_names_the_subject(telling: TemplateStore) -> None:
    put(telling, "ann-of-the-outbox", b"1")
    telling.erasures.erase("default", "ann-of-the-outbox")
    first, second = rows(telling)
    assert first["pseudonym"] == second["pseudonym"]
    for row in (first, second):
        assert b"ann-of-the-outbox" not in b"".join(
            value if isinstance(value, bytes) else str(value).encode() for value in row.values()
        )


def test_events_outlive_a_change_of_the_master_key_and_of_the_secrets(
    telling: TemplateStore, key_file: Path, database_url: str, clock: Clock
) -> None:
    store = TemplateStore(
        database_url, MasterKeyring.load(key_file), clock=clock, tells_events=True
    )
    try:
        put(store, "ann", b"1", template_id="a")
        before = rows(store)[0]
        MasterKeyring.add_current(key_file)
        store.wrapped_keys.rewrap()
        MasterKeyring.drop_retired(key_file, keep=MasterKeyring.load(key_file).current)
        store.renewal.renew()
        put(store, "ann", b"1", template_id="b")
        first, second = rows(store)
        assert first["wrapping_key"] != before["wrapping_key"]
        assert first["pseudonym"] == second["pseudonym"] != before["pseudonym"]
        for expected in "ab":
            event = store.outbox.claim()
            assert store.outbox.claim() is None
            assert told(event)["data"]["template_id"] == expected
            store.outbox.taken(event)
    finally:
        store.close()


def test_a_worker_without_the_master_key_leaves_the_event_to_others(
    telling: TemplateStore, key_file: Path, tmp_path: Path, database_url: str, clock: Clock
) -> None:
    before = tmp_path / "before.key"
    before.write_bytes(key_file.read_bytes())
    before.chmod(0o600)
    MasterKeyring.add_current(key_file)
    late, current = (
        TemplateStore(database_url, MasterKeyring.load(path), clock=clock, tells_events=True)
        for path in (before, key_file)
    )
    try:
        put(current, "ann", b"1")
        assert late.outbox.claim() is None
        clock.time += LEASE
        assert told(current.outbox.claim())["data"]["subject_id"] == "ann"
    finally:
        late.close()
        current.close()


def test_without_a_secret_nothing_is_kept(store: TemplateStore) -> None:
    put(store, "ann", b"1")
    store.erasures.erase("default", "ann")
    assert store.outbox.waiting() == 0


def test_an_enrollment_that_fails_is_not_told(
    telling: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = telling.outbox.add

    def add_and_fail(*arguments: object, **fields: object) -> None:
        add(*arguments, **fields)
        raise RuntimeError

    monkeypatch.setattr(telling.outbox, "add", add_and_fail)
    with pytest.raises(RuntimeError):
        put(telling, "ann", b"1")
    assert telling.outbox.waiting() == 0
    assert template_id(telling, "ann") is None


def test_a_message_has_a_signature_by_each_secret() -> None:
    # As the specification of Standard Webhooks computes it.
    signed = signatures(SECRETS, "msg_1", 1700000000, '{"a":1}').split(" ")
    for secret, one in zip(SECRETS, signed, strict=True):
        mac = hmac.new(secret, b'msg_1.1700000000.{"a":1}', hashlib.sha256).digest()
        assert one == f"v1,{base64.b64encode(mac).decode()}"


def test_events_of_an_erased_tenant_go_with_it(telling: TemplateStore) -> None:
    telling.tenants.create("other")
    put(telling, "ann", b"1")
    put(telling, "ann", b"1", tenant="other")
    telling.tenant_erasures.erase("other")
    assert telling.outbox.waiting() == 1
    assert told(telling.outbox.claim())["data"]["tenant"] == "default"


def killed_in(work: Callable[[], object]) -> None:
    """Run in a process of its own, which `work` is to kill."""
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def kill(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_an_event_is_there_with_what_it_tells_or_not_at_all(
    telling: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Committed, and not answered.
    killed_in(lambda: kill(put(telling, "ann", b"1")))
    assert template_id(telling, "ann") is not None
    # Written, and not committed.
    add = telling.outbox.add
    with monkeypatch.context() as patch:
        patch.setattr(telling.outbox, "add", lambda *given, **data: kill(add(*given, **data)))
        killed_in(lambda: put(telling, "bob", b"1"))
    assert template_id(telling, "bob") is None
    assert told(telling.outbox.claim())["data"]["subject_id"] == "ann"
    assert telling.outbox.waiting() == 1


@pytest.mark.parametrize("conclude", ["taken", "postpone"])
@pytest.mark.parametrize("committed", [False, True])
def test_a_worker_killed_between_claim_and_end_leaves_the_event(
    telling: TemplateStore,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
    conclude: str,
    committed: bool,
) -> None:
    put(telling, "ann", b"1")
    write = telling.database.write

    def killed_before_the_commit(work: Callable[[Connection], object], **how: object) -> object:
        return write(lambda connection: kill(work(connection)), **how)

    def work() -> None:
        event = telling.outbox.claim()
        if not committed:
            monkeypatch.setattr(telling.database, "write", killed_before_the_commit)
        getattr(telling.outbox, conclude)(event)
        kill()

    killed_in(work)
    if committed and conclude == "taken":
        assert telling.outbox.waiting() == 0
        return
    if not committed:
        assert telling.outbox.claim() is None, "the claim of the dead one holds"
    clock.time += LEASE
    again = telling.outbox.claim()
    assert (told(again)["data"]["subject_id"], again.attempts) == ("ann", 2)
