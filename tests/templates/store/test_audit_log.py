"""The audit log: what writes a line, what a line holds, and which tampering is found."""

import hashlib
import hmac
import os
import random
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import astuple
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, TextIO

import pytest
import sqlalchemy as sa

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import (
    Anchor,
    BrokenAuditLog,
    By,
    Entry,
    InvalidIdentifier,
    Line,
    Problem,
    TemplateStore,
    UnknownTenant,
)
from templates.store.audit_chain import MAX_PROBLEMS, Chain, LineKeys, head_mac, line_hash
from templates.store.database import Database
from templates.store.schema import AuditHeadRow, AuditRow, SubjectRow
from templates.store.secret import SecretName
from tests.templates.store.conftest import Clock, put
from tests.templates.store.test_concurrency import fork

LINES = 8

# The children do nothing but use the store; threads that other tests left behind are not theirs.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")

SQLITE_TRIGGERS = (
    "audit_log_no_update",
    "audit_log_no_delete",
    "audit_log_no_replace",
    "audit_head_no_delete",
)


def entry(number: int) -> Entry:
    return Entry(
        "verify",
        "reject",
        By("key:00112233aabb", f"request-{number:08}"),
        tenant="default",
        pseudonym=f"{number:064x}",
        detail="high",
    )


@pytest.fixture
def filled(store: TemplateStore, clock: Clock) -> TemplateStore:
    """A store with eight lines, seconds apart."""
    for number in range(1, LINES + 1):
        clock.pass_by(seconds=1.5)
        store.audit_log.record(entry(number))
    return store


@pytest.fixture
def attacker(filled: TemplateStore, database_url: str) -> Iterator[Callable[..., None]]:
    """Runs SQL as one who may do everything to the database, and has no master key."""
    database = Database(database_url)

    def execute(*statements: str, **values: object) -> None:
        def work(connection: sa.Connection) -> None:
            for statement in statements:
                connection.execute(sa.text(statement), values)

        database.write(work)

    if database.is_sqlite:
        execute(*(f"DROP TRIGGER {name}" for name in SQLITE_TRIGGERS))
    else:
        execute(
            "ALTER TABLE audit_log DISABLE TRIGGER USER",
            "ALTER TABLE audit_head DISABLE TRIGGER USER",
        )
    yield execute
    database.close()


def problems(store: TemplateStore, anchor: Anchor | None = None) -> list[tuple[object, ...]]:
    found = store.audit_log.verify(anchor=anchor, batch=3)
    assert found.intact == (not found.problems)
    return [astuple(problem) for problem in found.problems]


# --- lines and their chain -----------------------------------------------------------------


def test_an_empty_log_is_intact(store: TemplateStore) -> None:
    found = store.audit_log.verify()
    assert (found.lines, found.intact, found.head) == (0, True, Anchor(0, bytes(32)))
    assert store.audit_log.head() == found.head
    assert list(store.audit_log.lines()) == []


def test_the_first_line_and_those_after_it(store: TemplateStore, clock: Clock) -> None:
    first = entry(1)
    store.audit_log.record(first)
    store.audit_log.record(Entry("key-revoke", "unknown_key", By()))
    one, two = store.audit_log.lines()
    assert one == Line(
        sequence=1,
        at=clock.time,
        tenant="default",
        actor="key:00112233aabb",
        action="verify",
        pseudonym=first.pseudonym,
        outcome="reject",
        request_id="request-00000001",
        detail="high",
        nonce=None,
        previous_hash=bytes(32),
        hash=one.hash,
    )
    assert (two.sequence, two.actor, two.tenant, two.detail) == (2, "program", None, None)
    assert two.previous_hash == one.hash
    assert store.audit_log.head() == Anchor(2, two.hash)
    assert store.audit_log.verify().head == Anchor(2, two.hash)


def test_the_hash_is_a_plain_hmac(store: TemplateStore) -> None:
    """Computed here from the documented encoding alone."""
    store.audit_log.record(entry(1))
    store.audit_log.record(Entry("key-revoke", "unknown_key", By()))
    _, line = store.audit_log.lines()

    def part(kind: bytes, body: bytes) -> bytes:
        return kind + len(body).to_bytes(8, "big") + body

    parts = [part(b"t", b"line"), part(b"i", b"2")]
    parts += [part(b"t", b"2026-03-01T12:00:00.123456+00:00"), part(b"i", b"0")]
    parts += [part(b"t", b"program"), part(b"t", b"key-revoke"), part(b"i", b"0")]
    parts += [part(b"t", b"unknown_key"), part(b"i", b"0"), part(b"i", b"0")]
    parts += [part(b"b", line.previous_hash)]
    message = len(parts).to_bytes(4, "big") + b"".join(parts)
    key = store.secrets.get(SecretName.CHAIN).value
    assert line.hash == hmac.new(key, message, hashlib.sha256).digest()


def test_lines_are_read_in_batches_from_anywhere(filled: TemplateStore) -> None:
    numbers = [line.sequence for line in filled.audit_log.lines(batch=3)]
    assert numbers == list(range(1, LINES + 1))
    assert [line.sequence for line in filled.audit_log.lines(after=6, batch=1)] == [7, 8]
    assert list(filled.audit_log.lines(after=LINES)) == []


def test_the_latest_lines_of_a_tenant_come_first(
    filled: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = filled.audit_log
    for _ in range(3):
        log.record(Entry("verify", "accept", By(), tenant="other"))
    log.record(entry(1))
    expected = [line for line in log.lines() if line.tenant == "default"][::-1]

    def pages(limit: int, pseudonyms: tuple[str, ...] = ()) -> list[list[Line | None]]:
        lines, before = log.page("default", limit=limit, pseudonyms=pseudonyms)
        read = [lines]
        while before is not None:
            lines, before = log.page("default", limit=limit, before=before, pseudonyms=pseudonyms)
            read.append(lines)
        return [[line for _, line in page] for page in read]

    for limit in (1, 4, 1000):
        assert list(chain.from_iterable(pages(limit))) == expected
        assert {len(page) for page in pages(limit)[:-1]} <= {limit}
    (about_one,) = pages(1000, (f"{1:064x}",))
    assert [line and line.pseudonym for line in about_one] == [f"{1:064x}"] * 2
    # However many lines are others', a page looks through a few, and the next ones go on.
    monkeypatch.setattr("templates.store.audit_log.SCANNED", 2)
    assert list(chain.from_iterable(pages(1000))) == expected
    assert [] in pages(1000)
    assert log.page("nobody", limit=5, before=2) == ([], None)


def test_a_tenant_does_not_read_the_lines_of_an_erased_one_of_its_name(
    filled: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = filled.audit_log
    _, before = log.page("default", limit=2)
    filled.tenant_erasures.erase("default")
    filled.tenants.create("default")
    log.record(entry(9))
    for scanned in (50_000, 2):
        monkeypatch.setattr("templates.store.audit_log.SCANNED", scanned)
        lines, earlier = log.page("default", limit=100)
        assert [line and line.pseudonym for _, line in lines] == [f"{9:064x}"]
        assert earlier is None
        assert log.page("default", limit=100, before=before) == ([], None)
    assert log.page("default", limit=100, pseudonyms=(f"{1:064x}",)) == ([], None)


@pytest.mark.parametrize("number", [10**12, 2**63 - 1])
def test_a_page_begins_at_the_head_and_shows_altered_lines_as_such(
    filled: TemplateStore, attacker: Callable[..., None], number: int
) -> None:
    log = filled.audit_log
    expected: list[tuple[int, Line | None]] = [
        (line.sequence, line) for line in reversed(list(log.lines())) if line.tenant == "default"
    ]
    attacker(COPY.format(number, "hash", "previous_hash"))
    assert log.page("default", limit=100) == (expected, None)
    # One that cannot be read, one that can, and one that would hide those before it.
    attacker(
        "UPDATE audit_log SET hash = previous_hash || hash WHERE sequence = 4",
        "UPDATE audit_log SET outcome = 'accept' WHERE sequence = 5",
        "UPDATE audit_log SET action = 'tenant-erase', outcome = 'erased' WHERE sequence = 6",
    )
    told = [(number, None if number in (4, 5, 6) else line) for number, line in expected]
    assert log.page("default", limit=100) == (told, None)
    attacker("UPDATE audit_head SET sequence = 1")
    with pytest.raises(BrokenAuditLog):
        log.page("default", limit=100)


def test_an_intact_log_verifies_in_batches(filled: TemplateStore) -> None:
    batches: list[int] = []
    found = filled.audit_log.verify(batch=3, progress=batches.append)
    assert found.intact
    assert found.lines == LINES
    assert batches == [3, 3, 2]


def test_a_rolled_back_write_leaves_no_line(store: TemplateStore) -> None:
    store.audit_log.record(entry(1))
    with pytest.raises(UnknownTenant):
        put(store, "ada", b"wire", tenant="nowhere")

    def work(connection: sa.Connection) -> None:
        store.audit_log.append(connection, entry(2))
        raise RuntimeError

    with pytest.raises(RuntimeError):
        store.database.write(work)
    store.audit_log.record(entry(3))
    assert [line.request_id for line in store.audit_log.lines()] == [
        "request-00000001",
        "request-00000003",
    ]
    assert store.audit_log.verify().intact


def test_two_lines_in_one_transaction(store: TemplateStore) -> None:
    store.audit_log.prepare()

    def work(connection: sa.Connection) -> None:
        store.audit_log.append(connection, entry(1))
        store.audit_log.append(connection, entry(2))

    store.database.write(work)
    assert store.audit_log.verify().lines == 2
    assert store.audit_log.verify().intact


def test_appending_unprepared_is_refused_and_does_not_hang(
    database_url: str, keyring: MasterKeyring, store: TemplateStore
) -> None:
    store.close()
    store = TemplateStore(database_url, keyring)
    with pytest.raises(RuntimeError, match="prepare"):
        store.database.write(lambda each: store.audit_log.append(each, entry(1)))
    store.close()


def test_the_chain_survives_a_rotation_of_the_master_key(
    filled: TemplateStore, database_url: str, key_file: Path
) -> None:
    head = filled.audit_log.head()
    current = MasterKeyring.add_current(key_file)
    filled.wrapped_keys.rewrap()
    MasterKeyring.drop_retired(key_file, keep=current)
    fresh = TemplateStore(database_url, MasterKeyring.load(key_file))
    fresh.audit_log.record(entry(9))
    assert fresh.audit_log.verify(anchor=head).intact
    fresh.close()


def test_another_master_key_does_not_verify(
    filled: TemplateStore, database_url: str, tmp_path: Path
) -> None:
    stranger = TemplateStore(database_url, MasterKeyring.create(tmp_path / "other.key"))
    for use in (
        stranger.audit_log.verify,
        stranger.audit_log.head,
        lambda: stranger.audit_log.record(entry(9)),
    ):
        with pytest.raises(SealError):
            use()
    stranger.close()
    assert filled.audit_log.verify().intact


# --- who writes lines ----------------------------------------------------------------------


def test_every_write_has_its_line(store: TemplateStore) -> None:
    by = By("operator:root", "request-12345678")
    put(store, "ada", b"one", by=by)
    put(store, "ada", b"two", by=by)
    store.erasures.erase("default", "ada", by=by)
    store.erasures.erase("default", "ada", by=by)
    store.erasures.erase("default", "eve", by=by)
    key = store.api_keys.create("other", ["verify"], by=by).key
    assert store.api_keys.revoke(key.prefix, by=by)
    assert not store.api_keys.revoke(key.prefix, by=by)
    assert not store.api_keys.revoke("vf_secret", by=by)
    assert store.api_keys.bootstrap(by=by) is None
    ada, eve = (store.signer.pseudonym("default", name) for name in ("ada", "eve"))
    assert [
        (line.action, line.outcome, line.tenant, line.pseudonym, line.detail)
        for line in store.audit_log.lines()
    ] == [
        ("enroll", "created", "default", ada, None),
        ("enroll", "replaced", "default", ada, None),
        ("erase", "erased", "default", ada, None),
        ("erase", "receipt_repeated", "default", ada, None),
        ("erase", "nothing_held", "default", eve, None),
        ("key-create", "created", "other", None, key.prefix),
        ("key-revoke", "revoked", "other", None, key.prefix),
        ("key-revoke", "revoked_before", "other", None, key.prefix),
        ("key-revoke", "unknown_key", None, None, None),
    ]
    assert {(line.actor, line.request_id) for line in store.audit_log.lines()} == {
        ("operator:root", "request-12345678")
    }
    assert store.audit_log.verify().intact


def test_the_bootstrap_key_has_its_line(store: TemplateStore) -> None:
    new = store.api_keys.bootstrap()
    assert new is not None
    (line,) = store.audit_log.lines()
    assert (line.action, line.actor, line.detail) == ("key-create", "program", new.key.prefix)


def test_no_line_holds_a_subject_id_a_token_or_a_template(
    store: TemplateStore, database_url: str
) -> None:
    put(store, "lovelace", b"template-bytes")
    token = store.api_keys.create("default", ["verify"]).token
    store.api_keys.revoke(token)
    store.erasures.erase("default", "lovelace")
    database = Database(database_url)
    rows = database.read(lambda each: each.execute(sa.select(AuditRow.__table__)).all())
    assert len(rows) == 4
    text = repr(rows)
    assert store.signer.pseudonym("default", "lovelace") in text
    for secret in ("lovelace", "template-bytes", token, token.split("_")[2]):
        assert secret not in text
    database.close()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Entry("enroll", "created", By(), pseudonym="ada"),
        lambda: Entry("enroll", "created", By(), pseudonym="A" * 64),
        lambda: Entry("enroll", "created", By(), tenant="a b"),
        lambda: Entry("", "created", By()),
        lambda: Entry("enroll", "o" * 65, By()),
        lambda: Entry("enroll", "created", By(), detail="d" * 65),
        lambda: Entry("enroll", "created", By(), detail="a\nb"),
        lambda: By(""),
        lambda: By("operator:\x00"),
        lambda: By(request_id="r" * 65),
        lambda: Anchor.parse("1:zz"),
        lambda: Anchor.parse(f"-1:{'0' * 64}"),
    ],
)
def test_what_cannot_be_a_line_is_refused(make: Callable[[], object]) -> None:
    with pytest.raises(InvalidIdentifier):
        make()


def test_an_anchor_survives_its_text(filled: TemplateStore) -> None:
    head = filled.audit_log.head()
    assert Anchor.parse(str(head)) == head
    assert str(head).startswith("8:")


# --- append-only ---------------------------------------------------------------------------


REFUSED = {
    "both": (
        "UPDATE audit_log SET outcome = 'accept' WHERE sequence = 3",
        "UPDATE audit_log SET sequence = 99 WHERE sequence = 3",
        "DELETE FROM audit_log WHERE sequence = 8",
        "DELETE FROM audit_log",
        "DELETE FROM audit_head",
    ),
    "sqlite": (
        "INSERT OR REPLACE INTO audit_log (sequence, at, action, outcome, previous_hash, hash) "
        "SELECT sequence, at, action, 'accept', previous_hash, hash FROM audit_log "
        "WHERE sequence = 3",
        "UPDATE OR REPLACE audit_log SET sequence = 4 WHERE sequence = 3",
    ),
    "postgresql": (
        "TRUNCATE audit_log",
        "TRUNCATE audit_head",
        "INSERT INTO audit_log SELECT * FROM audit_log WHERE sequence = 3 "
        "ON CONFLICT (sequence) DO UPDATE SET outcome = 'accept'",
    ),
}


def test_the_database_refuses_to_change_the_log(filled: TemplateStore, database_url: str) -> None:
    database = Database(database_url)
    here = "sqlite" if database.is_sqlite else "postgresql"
    for statement in (*REFUSED["both"], *REFUSED[here]):
        with pytest.raises(StoreError, match="refused the statement"):
            database.write(lambda each, sql=statement: each.execute(sa.text(sql)))
    database.close()
    assert filled.audit_log.verify().intact
    assert {line.outcome for line in filled.audit_log.lines()} == {"reject"}


def test_without_the_triggers_the_same_statements_go_through(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    """The control of the test above: it is the triggers that refuse."""
    attacker("UPDATE audit_log SET outcome = 'accept' WHERE sequence = 3")
    attacker("DELETE FROM audit_log WHERE sequence = 8")
    assert filled.audit_log.verify().lines == LINES - 1


# --- tampering -----------------------------------------------------------------------------

ALTERATIONS = {
    "at": "'2026-03-01 12:00:00.000001+00'",
    "tenant": "'other'",
    "actor": "'operator:root'",
    "action": "'enroll'",
    "pseudonym": f"'{0:064x}'",
    "outcome": "'accept'",
    "request_id": "'request-99999999'",
    "detail": "'low'",
    "nonce": "'0123'",
    "previous_hash": "hash",
    "hash": "previous_hash",
}


def test_every_column_is_altered_below() -> None:
    assert {*ALTERATIONS, "sequence"} == {column.name for column in AuditRow.__table__.columns}


def assert_found_and_put_back(
    store: TemplateStore, attacker: Callable[..., None], column: str, value: str, sequence: int
) -> None:
    """Alter one column of one line, look whether exactly that is found, and mend it."""
    named = AuditRow.__table__.columns[column]
    where = AuditRow.sequence == sequence
    old = store.database.read(lambda each: each.execute(sa.select(named).where(where)).scalar_one())
    attacker(f"UPDATE audit_log SET {column} = {value} WHERE sequence = {sequence}")
    assert problems(store) == [(sequence, "altered", None)], (column, value, sequence)
    mend = sa.update(AuditRow).where(where).values({named: old})
    store.database.write(lambda each: each.execute(mend))
    assert problems(store) == [], (column, value, sequence)


@pytest.mark.parametrize("sequence", [1, 4, LINES])
def test_an_altered_column_is_found(
    filled: TemplateStore, attacker: Callable[..., None], sequence: int
) -> None:
    for column, value in ALTERATIONS.items():
        assert_found_and_put_back(filled, attacker, column, value, sequence)
    for column in ("tenant", "pseudonym", "request_id", "detail", "actor"):
        assert_found_and_put_back(filled, attacker, column, "NULL", sequence)


def test_null_is_neither_empty_nor_zero(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    filled.audit_log.record(Entry("key-revoke", "unknown_key", By()))
    for column in ("tenant", "pseudonym", "request_id", "detail"):
        for value in ("''", "'0'"):
            assert_found_and_put_back(filled, attacker, column, value, LINES + 1)


def test_sqlite_values_of_no_type_of_ours_are_named_and_not_stumbled_over(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    store = TemplateStore(f"sqlite:///{tmp_path / 'veilface.db'}", keyring)
    store.upgrade()
    for number in range(3):
        store.audit_log.record(entry(number))

    def attacker(statement: str) -> None:
        store.database.write(lambda each: each.execute(sa.text(statement)))

    attacker("DROP TRIGGER audit_log_no_update")
    for column in ALTERATIONS:
        for value in ("x'ff'", "CAST(x'ff' AS TEXT)", "7", "x''", "'8' || hex(0)"):
            assert_found_and_put_back(store, attacker, column, value, 2)
    store.close()


def test_postgresql_times_beyond_python_are_named_and_not_stumbled_over(
    postgres_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(postgres_url, keyring)
    store.upgrade()
    store.audit_log.record(entry(1))

    def attacker(statement: str) -> None:
        store.database.write(lambda each: each.execute(sa.text(statement)))

    attacker("ALTER TABLE audit_log DISABLE TRIGGER USER")
    for value in ("infinity", "-infinity", "0044-03-15 BC", "20000-01-01"):
        assert_found_and_put_back(store, attacker, "at", f"'{value}'", 1)
    store.close()


def test_a_line_that_cannot_be_read_sends_its_reader_to_the_verification(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    attacker("UPDATE audit_log SET hash = previous_hash || hash WHERE sequence = 4")
    with pytest.raises(StoreError, match=r"line 4 .* `veilface audit-log verify`"):
        list(filled.audit_log.lines(batch=1))
    assert problems(filled) == [(4, "altered", None)]


def test_a_removed_middle_line_is_found(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    attacker("DELETE FROM audit_log WHERE sequence IN (3, 4, 6)")
    assert problems(filled) == [(3, "missing", 4), (6, "missing", 6)]


def test_a_removed_line_whose_gap_is_closed_is_found(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    attacker(
        "DELETE FROM audit_log WHERE sequence = 7",
        "UPDATE audit_log SET sequence = 7 WHERE sequence = 8",
        "UPDATE audit_head SET sequence = 7",
    )
    assert problems(filled) == [(7, "altered", None), (7, "head does not match", None)]


def test_a_removed_first_line_is_found(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    attacker("DELETE FROM audit_log WHERE sequence = 1")
    assert problems(filled) == [(1, "missing", 1)]


def test_a_removed_tail_is_found(filled: TemplateStore, attacker: Callable[..., None]) -> None:
    attacker("DELETE FROM audit_log WHERE sequence > 5")
    assert problems(filled) == [(6, "missing", 8)]


def test_a_removed_tail_with_a_forged_head_is_found(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    attacker(
        "DELETE FROM audit_log WHERE sequence > 5",
        "UPDATE audit_head SET sequence = 5, "
        "hash = (SELECT hash FROM audit_log WHERE sequence = 5)",
    )
    assert problems(filled) == [(5, "head does not match", None)]


def test_a_log_without_any_line_is_found(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    attacker("DELETE FROM audit_log")
    assert problems(filled) == [(1, "missing", LINES)]


@pytest.mark.parametrize("lines_too", [False, True])
def test_a_removed_head_row_is_found(
    filled: TemplateStore, attacker: Callable[..., None], lines_too: bool
) -> None:
    attacker("DELETE FROM audit_head")
    if lines_too:
        attacker("DELETE FROM audit_log")
    filled.upgrade()  # must not make it anew
    last = 0 if lines_too else LINES
    assert problems(filled) == [(last, "head does not match", None)]
    for use in (filled.audit_log.head, lambda: filled.audit_log.record(entry(9))):
        with pytest.raises(BrokenAuditLog, match="veilface audit-log verify"):
            use()


@pytest.mark.parametrize("change", ["sequence = sequence + 1", "hash = mac", "mac = hash"])
def test_an_altered_head_row_is_found_and_not_built_upon(
    filled: TemplateStore, attacker: Callable[..., None], change: str
) -> None:
    attacker(f"UPDATE audit_head SET {change}")
    assert problems(filled) == [(LINES, "head does not match", None)]
    with pytest.raises(BrokenAuditLog):
        put(filled, "ada", b"wire")
    assert filled.subjects.get("default", "ada") is None
    assert filled.audit_log.verify().lines == LINES


def test_a_head_of_another_deployment_is_found(
    filled: TemplateStore, attacker: Callable[..., None], tmp_path: Path
) -> None:
    """A true MAC under another key, of the right number and hash."""
    head = filled.audit_log.head()
    attacker("UPDATE audit_head SET mac = :mac", mac=head_mac(bytes(32), head))
    assert problems(filled) == [(LINES, "head does not match", None)]


def test_swapped_lines_are_found(filled: TemplateStore, attacker: Callable[..., None]) -> None:
    attacker(
        "UPDATE audit_log SET sequence = 100 WHERE sequence = 3",
        "UPDATE audit_log SET sequence = 3 WHERE sequence = 6",
        "UPDATE audit_log SET sequence = 6 WHERE sequence = 100",
    )
    assert problems(filled) == [(3, "altered", None), (6, "altered", None)]


COPY = (
    "INSERT INTO audit_log (sequence, at, tenant, actor, action, pseudonym, outcome, request_id, "
    "detail, previous_hash, hash) SELECT {}, at, tenant, actor, action, pseudonym, outcome, "
    "request_id, detail, {}, {} FROM audit_log WHERE sequence = 8"
)


@pytest.mark.parametrize(
    ("sequence", "found"),
    [
        (9, [(9, "altered", None), (9, "head does not match", None)]),
        (12, [(9, "missing", 11), (12, "altered", None), (12, "head does not match", None)]),
        (-5, [(-5, "altered", None)]),
    ],
)
def test_an_inserted_line_is_found(
    filled: TemplateStore,
    attacker: Callable[..., None],
    sequence: int,
    found: list[tuple[object, ...]],
) -> None:
    attacker(COPY.format(sequence, "hash", "previous_hash"))
    assert problems(filled) == found


def test_a_line_that_is_there_twice_is_found(postgres_url: str, keyring: MasterKeyring) -> None:
    """Without the primary key; the second one falls between two batches."""
    store = TemplateStore(postgres_url, keyring)
    store.upgrade()
    for number in range(3):
        store.audit_log.record(entry(number))
    for statement in (
        "ALTER TABLE audit_log DISABLE TRIGGER USER",
        "ALTER TABLE audit_log DROP CONSTRAINT pk_audit_log",
        "INSERT INTO audit_log SELECT * FROM audit_log WHERE sequence = 2",
    ):
        store.database.write(lambda each, sql=statement: each.execute(sa.text(sql)))
    assert store.audit_log.verify(batch=2).problems == (Problem(3, "lines that share a number"),)
    assert store.audit_log.verify(batch=9).problems == (Problem(2, "out of order"),)
    store.close()


def test_a_rolled_back_log_is_found_with_an_anchor_only(
    filled: TemplateStore, attacker: Callable[..., None], database_url: str
) -> None:
    early = filled.audit_log.head()
    query = sa.select(AuditHeadRow.sequence, AuditHeadRow.hash, AuditHeadRow.mac)
    old = filled.database.read(lambda each: each.execute(query).one())
    for number in range(9, 12):
        filled.audit_log.record(entry(number))
    late = filled.audit_log.head()
    assert problems(filled, early) == problems(filled, late) == []

    attacker(
        "DELETE FROM audit_log WHERE sequence > 8",
        "UPDATE audit_head SET sequence = :sequence, hash = :hash, mac = :mac",
        **old._mapping,
    )
    assert problems(filled) == []  # what the documentation says: a true state, only an old one
    assert problems(filled, early) == []
    assert problems(filled, late) == [(11, "anchor not in chain", None)]

    for number in range(19, 22):
        filled.audit_log.record(entry(number))
    assert filled.audit_log.head().sequence == late.sequence
    assert problems(filled, late) == [(11, "anchor not in chain", None)]
    assert problems(filled, early) == []
    assert problems(filled, Anchor(0, bytes(32))) == []
    assert problems(filled, Anchor(0, b"\1" * 32)) == [(0, "anchor not in chain", None)]


WIPED = (
    "DELETE FROM audit_log",
    "UPDATE audit_head SET sequence = 0, hash = :zeros, mac = :none",
)


def test_a_log_that_was_wiped_is_found(
    filled: TemplateStore, attacker: Callable[..., None], database_url: str, key_file: Path
) -> None:
    """The head is put back to what the migration wrote, which had no key to MAC it with."""
    attacker(*WIPED, zeros=bytes(32), none=b"")
    fresh = TemplateStore(database_url, MasterKeyring.load(key_file))
    fresh.upgrade()  # must not sign it
    for store in (filled, fresh):
        assert problems(store) == [(0, "head does not match", None)]
        for use in (store.audit_log.head, lambda each=store: each.audit_log.record(entry(9))):
            with pytest.raises(BrokenAuditLog, match="veilface audit-log verify"):
                use()
    fresh.close()


@pytest.mark.parametrize(
    "also",
    [
        (),
        ("DELETE FROM audit_log",),
        ("DELETE FROM audit_head",),
        ("UPDATE audit_head SET sequence = 0, hash = :zeros, mac = :none",),
        ("DELETE FROM audit_log", "DELETE FROM audit_head"),
        ("DELETE FROM audit_log", "UPDATE audit_head SET sequence = 0, hash = :zeros"),
    ],
)
def test_the_key_of_a_log_that_began_is_not_made_anew(
    filled: TemplateStore,
    attacker: Callable[..., None],
    database_url: str,
    key_file: Path,
    also: tuple[str, ...],
) -> None:
    attacker("DELETE FROM secrets WHERE name = 'audit-chain'")
    for statement in also:
        values = {"zeros": bytes(32), "none": b""}
        attacker(statement, **{name: values[name] for name in values if f":{name}" in statement})
    fresh = TemplateStore(database_url, MasterKeyring.load(key_file))
    for use in (
        fresh.upgrade,
        fresh.audit_log.verify,
        fresh.audit_log.head,
        lambda: fresh.audit_log.record(entry(9)),
        lambda: put(fresh, "ada", b"wire"),
        fresh.upgrade,
    ):
        with pytest.raises(BrokenAuditLog, match="the key of the audit log is missing"):
            use()
    fresh.close()


def test_a_log_without_lines_mac_and_key_is_found_with_an_anchor_only(
    filled: TemplateStore, attacker: Callable[..., None], database_url: str, key_file: Path
) -> None:
    """What the documentation says: it is taken for one that never began."""
    anchor = filled.audit_log.head()
    attacker(*WIPED, zeros=bytes(32), none=b"")
    attacker("DELETE FROM secrets WHERE name = 'audit-chain'")
    fresh = TemplateStore(database_url, MasterKeyring.load(key_file))
    with pytest.raises(BrokenAuditLog):
        fresh.audit_log.verify()
    fresh.upgrade()
    assert problems(fresh) == []
    assert problems(fresh, anchor) == [(8, "anchor not in chain", None)]
    fresh.close()


@pytest.mark.parametrize(
    ("table", "column", "found"),
    [
        ("audit_log", "hash", [(4, "altered", None)]),
        ("audit_log", "previous_hash", [(4, "altered", None)]),
        ("audit_log", "at", [(4, "altered", None)]),
        ("audit_log", "action", [(4, "altered", None)]),
        ("audit_head", "sequence", [(LINES, "head does not match", None)]),
        ("audit_head", "hash", [(LINES, "head does not match", None)]),
        ("audit_head", "mac", [(LINES, "head does not match", None)]),
    ],
)
def test_a_column_without_a_value_is_named_and_not_stumbled_over(
    filled: TemplateStore,
    attacker: Callable[..., None],
    table: str,
    column: str,
    found: list[tuple[object, ...]],
) -> None:
    """As one leaves it who makes the column again without its NOT NULL."""
    if filled.database.is_sqlite:
        made = "(sequence INTEGER PRIMARY KEY, at, tenant, actor, action, pseudonym, outcome, "
        made += "request_id, detail, nonce, previous_hash, hash)"
        if table == "audit_head":
            made = "(id INTEGER PRIMARY KEY, sequence, hash, mac)"
        names = made.strip("()").replace(" INTEGER PRIMARY KEY", "")
        attacker(
            f"ALTER TABLE {table} RENAME TO old",
            f"CREATE TABLE {table} {made}",
            f"INSERT INTO {table} SELECT {names} FROM old",
        )
    else:
        attacker(f"ALTER TABLE {table} ALTER COLUMN {column} DROP NOT NULL")
    assert problems(filled) == []
    attacker(
        f"UPDATE {table} SET {column} = NULL" + (" WHERE sequence = 4" * (table == "audit_log"))
    )
    assert problems(filled) == found
    if table == "audit_head":
        for use in (filled.audit_log.head, lambda: filled.audit_log.record(entry(9))):
            with pytest.raises(BrokenAuditLog):
                use()
    elif column != "action":
        with pytest.raises(StoreError, match=r"line 4 .* `veilface audit-log verify`"):
            list(filled.audit_log.lines())


def test_a_last_line_without_a_hash_can_be_told() -> None:
    chain = Chain(LineKeys(KEY))
    chain.step({**next(made_up_lines(1)), "hash": None})
    head = Anchor(1, bytes(32))
    found = chain.end(head, head_mac(KEY, head), held=1)
    assert found.problems == (Problem(1, "altered"),)
    assert str(found.head) == "1:"


@pytest.mark.parametrize("identifier", [0, 2])
def test_a_second_head_row_is_found(
    filled: TemplateStore, attacker: Callable[..., None], identifier: int
) -> None:
    """Beside the true one, before it or after it."""
    attacker(
        "INSERT INTO audit_head (id, sequence, hash, mac) "
        f"SELECT {identifier}, sequence, hash, mac FROM audit_head"
    )
    assert problems(filled) == [(LINES, "head does not match", None)]
    for use in (filled.audit_log.head, lambda: filled.audit_log.record(entry(9))):
        with pytest.raises(BrokenAuditLog):
            use()


def test_lines_of_two_histories_do_not_mix(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    """Each line is a true one, written after the log was rolled back: only the links are wrong."""
    head = sa.select(AuditHeadRow.sequence, AuditHeadRow.hash, AuditHeadRow.mac)
    old = filled.database.read(lambda each: each.execute(head).one())
    filled.audit_log.record(entry(9))
    filled.audit_log.record(entry(10))
    first_history = list(filled.audit_log.lines(after=8))
    attacker(
        "DELETE FROM audit_log WHERE sequence > 8",
        "UPDATE audit_head SET sequence = :sequence, hash = :hash, mac = :mac",
        **old._mapping,
    )
    filled.audit_log.record(entry(109))
    filled.audit_log.record(entry(110))
    attacker("DELETE FROM audit_log WHERE sequence = 9")
    line = first_history[0]
    values = {name: getattr(line, name) for name in Line.__dataclass_fields__}
    filled.database.write(lambda each: each.execute(sa.insert(AuditRow).values(**values)))
    assert problems(filled) == [(10, "out of order", None)]


# --- beside others, and large --------------------------------------------------------------


def test_processes_append_to_one_chain(store: TemplateStore) -> None:
    def work(seed: int) -> None:
        for number in range(25):
            if number % 5 == 4:
                put(store, f"s{seed % 2}", b"wire")
            else:
                store.audit_log.record(entry(1000 * seed + number))

    def child(seed: int) -> tuple[int, TextIO]:
        return fork(lambda output: work(seed))

    children = [child(seed) for seed in range(1, 5)]
    while_running = store.audit_log.verify(batch=7)
    for process, output in children:
        output.close()
        assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 0
    assert while_running.intact
    found = store.audit_log.verify(anchor=while_running.head)
    assert found.intact
    assert found.lines == 100
    recorded = [line.request_id for line in store.audit_log.lines() if line.request_id]
    expected = [f"request-{1000 * seed + n:08}" for seed in range(1, 5) for n in range(25)]
    assert sorted(recorded) == [each for each in expected if int(each[-8:]) % 5 != 4]


def test_verifying_beside_writers_ends_and_is_clean(
    store: TemplateStore, database_url: str, key_file: Path
) -> None:
    errors = list[BaseException]()
    reader = TemplateStore(database_url, MasterKeyring.load(key_file))

    def write() -> None:
        try:
            for _ in range(40):
                store.audit_log.record(entry(1))
        except BaseException as error:
            errors.append(error)

    found = [reader.audit_log.verify(batch=5)]
    threads = [threading.Thread(target=write) for _ in range(3)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        found.append(reader.audit_log.verify(batch=5))
    found.append(reader.audit_log.verify(batch=5))
    for thread in threads:
        thread.join()
    assert errors == []
    assert [each.problems for each in found] == [()] * len(found)
    assert found[-1].lines == found[0].lines + 3 * 40
    reader.close()


KEY = bytes(range(32))


def made_up_lines(count: int) -> Iterator[dict[str, Any]]:
    """Columns of a true chain under `KEY`, as the database hands them out."""
    previous, at = bytes(32), datetime(2026, 3, 1, tzinfo=UTC)
    for sequence in range(1, count + 1):
        columns = {
            "sequence": sequence,
            "at": at,
            "tenant": "default",
            "actor": "key:x",
            "action": "verify",
            "pseudonym": f"{sequence:064x}",
            "outcome": "reject",
            "request_id": "request-00000000",
            "detail": "high",
            "nonce": None,
            "previous_hash": previous,
        }
        previous = line_hash(KEY, columns)
        yield {**columns, "at": "2026-03-01 00:00:00.000000", "hash": previous}


def test_the_walk_takes_the_same_memory_however_long_the_log() -> None:
    """The store hands the chain a batch at a time, so this is what could grow."""

    def peak(count: int) -> tuple[int, Chain]:
        chain = Chain(LineKeys(KEY))
        tracemalloc.start()
        for columns in made_up_lines(count):
            chain.step(columns)
        _, highest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return highest, chain

    short, _ = peak(500)
    long, chain = peak(10_000)
    assert long < short + 20_000
    last = chain._last
    assert chain.end(last, head_mac(KEY, last), held=10_000).intact


def test_a_log_that_is_wrong_everywhere_does_not_fill_the_memory() -> None:
    chain = Chain(LineKeys(bytes(32)))  # another key: every line is wrong
    count = MAX_PROBLEMS + 700
    for columns in made_up_lines(count):
        chain.step(columns)
    found = chain.end(None, b"", held=count)
    assert len(found.problems) == MAX_PROBLEMS
    assert found.unlisted == 701


def test_a_log_of_many_lines_is_read_a_batch_at_a_time(
    filled: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 0
    read = Database.read

    def watched(self: Database, work: Callable[[sa.Connection], object]) -> object:
        nonlocal most
        result = read(self, work)
        if isinstance(result, list):
            most = max(most, len(result))
        return result

    monkeypatch.setattr(Database, "read", watched)
    filled.audit_log.verify(batch=3)
    assert most == 3
    most = 0
    assert len(list(filled.audit_log.lines(batch=2))) == LINES
    assert most == 2


@pytest.mark.parametrize("seed", range(5))
def test_any_change_of_any_line_is_found(seed: int) -> None:
    """A flipped bit in any value of any line, in memory."""
    generator = random.Random(seed)
    lines = list(made_up_lines(12))
    at = generator.randrange(12)
    column = generator.choice([name for name in lines[at] if name not in ("sequence", "nonce")])
    value = lines[at][column]
    raw = bytearray(value.encode() if isinstance(value, str) else value)
    raw[generator.randrange(len(raw))] ^= 1 << generator.randrange(7)
    lines[at][column] = raw.decode() if isinstance(value, str) else bytes(raw)
    chain = Chain(LineKeys(KEY))
    for columns in lines:
        chain.step(columns)
    assert Problem(at + 1, "altered") in chain.end(None, b"", held=12).problems


def test_an_enrollment_and_its_line_come_together_or_not_at_all(
    filled: TemplateStore, attacker: Callable[..., None]
) -> None:
    attacker("DELETE FROM audit_head")
    with pytest.raises(BrokenAuditLog):
        put(filled, "ada", b"wire")
    count = sa.select(sa.func.count()).select_from(SubjectRow)
    assert filled.database.read(lambda each: each.execute(count).scalar_one()) == 0
