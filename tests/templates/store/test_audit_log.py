"""The audit log: what writes a line, what a line holds, and which tampering is found."""

import contextlib
import hashlib
import hmac
import json
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import TextIO

import pytest
import sqlalchemy as sa

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import (
    Anchor,
    BrokenAuditLog,
    By,
    Entry,
    InvalidIdentifier,
    Line,
    TemplateStore,
    UnknownTenant,
    archive_audit_log,
    verify_archive,
    verify_audit_log,
)
from templates.store.audit_chain import START
from templates.store.audit_log import template_digest, token_digest
from templates.store.database import Database
from templates.store.schema import AuditRow, SubjectRow
from templates.store.secrets import SecretName
from tests.databases import execute
from tests.templates.store.conftest import Clock, put
from tests.templates.store.test_concurrency import in_processes

LINES = 8
TOKEN = token_digest("00112233aabb", "random id")

# The children do nothing but use the store; threads that other tests left behind are not theirs.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")


def entry(number: int) -> Entry:
    return Entry(
        "verify",
        "locked_out",
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
def attacker(filled: TemplateStore, database_url: str) -> Iterator[Callable[..., object]]:
    """Runs SQL as one who may do everything to the database, and has no master key."""
    database = Database(database_url)
    yield lambda *statements: execute(database, *statements)
    database.close()


def problem(store: TemplateStore, anchor: Anchor | None = None) -> tuple[int, str] | None:
    found = verify_audit_log(store, anchor=anchor).problem
    return None if found is None else (found.sequence, found.what)


# --- lines and their chain -----------------------------------------------------------------


def test_the_first_line_and_those_after_it(store: TemplateStore, clock: Clock) -> None:
    store.audit_log.record(entry(1))
    store.audit_log.record(Entry("key-revoke", "unknown_key", By()))
    one, two = store.audit_log.lines()
    assert one == Line(
        sequence=1,
        at=clock.time,
        tenant="default",
        actor="key:00112233aabb",
        action="verify",
        pseudonym=f"{1:064x}",
        outcome="locked_out",
        request_id="request-00000001",
        detail="high",
        token=None,
        mac=one.mac,
    )
    assert (two.sequence, two.actor, two.tenant, two.detail) == (2, "program", None, None)
    assert store.audit_log.head() == verify_audit_log(store).head == Anchor(2, two.mac)


def test_the_mac_is_a_plain_hmac(store: TemplateStore) -> None:
    """Computed here from the documented encoding alone."""
    store.audit_log.record(entry(1))
    store.audit_log.record(Entry("key-revoke", "unknown_key", By()))
    first, line = store.audit_log.lines()

    def part(kind: bytes, body: bytes) -> bytes:
        return kind + len(body).to_bytes(8, "big") + body

    parts = [part(b"t", b"line"), part(b"b", first.mac), part(b"i", b"2")]
    parts += [part(b"t", b"2026-03-01T12:00:00.123456+00:00"), part(b"i", b"0")]
    parts += [part(b"t", b"program"), part(b"t", b"key-revoke"), part(b"i", b"0")]
    parts += [part(b"t", b"unknown_key"), *[part(b"i", b"0")] * 3]
    message = len(parts).to_bytes(4, "big") + b"".join(parts)
    key = store.secrets.get(SecretName.CHAIN)
    assert line.mac == hmac.new(key, message, hashlib.sha256).digest()


def test_the_latest_lines_of_a_tenant_come_first(filled: TemplateStore) -> None:
    log = filled.audit_log
    for _ in range(3):
        log.record(Entry("verify", "accept", By(), tenant="other"))
    log.record(entry(1))
    expected = [line for line in log.lines() if line.tenant == "default"][::-1]

    def pages(limit: int, pseudonym: str | None = None) -> list[list[Line]]:
        lines, before = log.page("default", limit=limit, pseudonym=pseudonym)
        read = [lines]
        while before is not None:
            lines, before = log.page("default", limit=limit, before=before, pseudonym=pseudonym)
            read.append(lines)
        return read

    for limit in (1, 4, 9, 1000):
        assert list(chain.from_iterable(pages(limit))) == expected
        assert {len(page) for page in pages(limit)[:-1]} <= {limit}
        assert [] not in pages(limit)
    (about_one,) = pages(1000, f"{1:064x}")
    assert [line.pseudonym for line in about_one] == [f"{1:064x}"] * 2
    assert log.page("nobody", limit=5) == ([], None)
    # A tenant that is made anew does not read the lines of the erased one of its name.
    filled.erasures.erase_tenant("default")
    filled.tenants.create("default")
    log.record(entry(9))
    assert [line.pseudonym for line in log.page("default", limit=100)[0]] == [f"{9:064x}"]


def test_an_intact_log_verifies_in_batches(
    filled: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("templates.store.audit_chain.BATCH", 3)
    batches: list[int] = []
    verification = verify_audit_log(filled, progress=batches.append)
    assert verification.intact
    assert verification.lines == LINES
    assert batches == [3, 3, 2]


def test_a_rolled_back_write_leaves_no_line(store: TemplateStore) -> None:
    store.audit_log.record(entry(1))
    with pytest.raises(UnknownTenant):
        put(store, "ada", b"wire", tenant="nowhere")
    with contextlib.suppress(RuntimeError), store.database.write() as session:
        store.audit_log.append(session, entry(2))
        raise RuntimeError
    store.audit_log.record(entry(3))
    requests = [line.request_id for line in store.audit_log.lines()]
    assert requests == ["request-00000001", "request-00000003"]
    assert verify_audit_log(store).intact


# --- what writes lines ---------------------------------------------------------------------


def test_every_write_has_its_line(store: TemplateStore) -> None:
    by = By("operator:root", "request-12345678")
    put(store, "ada", b"one", by=by, template_id="one")
    put(store, "ada", b"two", by=by, token=TOKEN, template_id="two")
    store.erasures.erase("default", "ada", by=by)
    store.erasures.erase("default", "ada", by=by)
    store.erasures.erase("default", "eve", by=by)
    key = store.api_keys.create("other", ["verify"], by=by).key
    assert store.api_keys.revoke(key.prefix, by=by)
    assert not store.api_keys.revoke(key.prefix, by=by)
    assert not store.api_keys.revoke("vf_secret", by=by)
    ada, eve = (store.signer.pseudonym("default", name) for name in ("ada", "eve"))
    lines = list(store.audit_log.lines())
    assert [
        (line.action, line.outcome, line.tenant, line.pseudonym, line.detail, line.token)
        for line in lines
    ] == [
        ("enroll", "created", "default", ada, template_digest("one"), None),
        ("enroll", "replaced", "default", ada, template_digest("two"), TOKEN),
        ("erase", "erased", "default", ada, None, None),
        ("erase", "receipt_repeated", "default", ada, None, None),
        ("erase", "nothing_held", "default", eve, None, None),
        ("key-create", "created", "other", None, key.prefix, None),
        ("key-revoke", "revoked", "other", None, key.prefix, None),
        ("key-revoke", "revoked_before", "other", None, key.prefix, None),
        ("key-revoke", "unknown_key", None, None, None, None),
    ]
    assert {(line.actor, line.request_id) for line in lines} == {(by.actor, by.request_id)}
    assert verify_audit_log(store).intact


def test_no_line_holds_a_subject_id_a_token_or_a_template(store: TemplateStore) -> None:
    put(store, "ada.lovelace", b"template of ada")
    token = store.api_keys.create("default", ["verify"]).token
    store.erasures.erase("default", "ada.lovelace")
    rows = execute(store.database, sa.select(AuditRow.__table__))
    for secret in ("ada.lovelace", "template of ada", token, token[16:]):
        assert secret not in repr(rows)


@pytest.mark.parametrize("name", ["pseudonym", "token"])
def test_a_line_takes_nothing_but_digests_for_subject_and_token(
    store: TemplateStore, name: str
) -> None:
    with pytest.raises(ValueError, match="digests"):
        store.audit_log.record(Entry("enroll", "created", By(), **{name: "ada"}))


def test_an_anchor_survives_its_text(filled: TemplateStore) -> None:
    head = filled.audit_log.head()
    assert Anchor.parse(str(head)) == head
    for text in ("", "8", f"8:{'0' * 63}", f"-1:{'0' * 64}", f"8:{'0' * 64}\n"):
        with pytest.raises(InvalidIdentifier):
            Anchor.parse(text)


# --- tampering -----------------------------------------------------------------------------

COPY = (
    "INSERT INTO audit_log SELECT {0}, at, tenant, actor, action, pseudonym, outcome, request_id, "
    "detail, token, mac FROM audit_log WHERE sequence = 5"
)
TAMPERING = {
    "NULL for a text": (["UPDATE audit_log SET detail = NULL WHERE sequence = 5"], 5),
    "a text for NULL": (["UPDATE audit_log SET token = '0' WHERE sequence = 5"], 5),
    "a removed line": (["DELETE FROM audit_log WHERE sequence = 5"], 5),
    "a removed line whose gap is closed": (
        ["DELETE FROM audit_log WHERE sequence = 5"]
        + [f"UPDATE audit_log SET sequence = {n - 1} WHERE sequence = {n}" for n in (6, 7, 8)],
        5,
    ),
    "a removed first line": (["DELETE FROM audit_log WHERE sequence = 1"], 1),
    "a removed tail": (["DELETE FROM audit_log WHERE sequence > 6"], 7),
    "a removed tail and a moved head": (
        [
            "DELETE FROM audit_log WHERE sequence > 6",
            "UPDATE audit_head SET sequence = 6, line_mac = "
            "(SELECT mac FROM audit_log WHERE sequence = 6)",
        ],
        0,
    ),
    "no line at all": (["DELETE FROM audit_log"], 1),
    "no head": (["DELETE FROM audit_head"], 0),
    "a second head": (
        [
            "INSERT INTO audit_head SELECT 2, base_sequence, base_mac, sequence, line_mac, mac "
            "FROM audit_head"
        ],
        0,
    ),
    "a moved base": (["UPDATE audit_head SET base_sequence = 4"], 0),
    "swapped lines": (
        [
            "UPDATE audit_log SET sequence = 0 WHERE sequence = 5",
            "UPDATE audit_log SET sequence = 5 WHERE sequence = 6",
            "UPDATE audit_log SET sequence = 6 WHERE sequence = 0",
        ],
        5,
    ),
    "a line beyond the head": ([COPY.format(9)], 9),
    "a line far beyond the head": ([COPY.format(2**62)], 9),
    "a line before the first": ([COPY.format(-3)], -3),
    "a line before all numbers": ([COPY.format(-(2**63))], -(2**63)),
}


@pytest.mark.parametrize("name", TAMPERING)
def test_tampering_is_found_at_its_first_line(
    filled: TemplateStore, attacker: Callable[..., object], name: str
) -> None:
    statements, sequence = TAMPERING[name]
    attacker(*statements)
    found = problem(filled)
    assert found is not None
    assert found[0] == sequence, found


@pytest.mark.parametrize("name", [column.key for column in AuditRow.__table__.columns][1:])
def test_every_column_is_covered(
    filled: TemplateStore, attacker: Callable[..., object], name: str
) -> None:
    value = "zeroblob(32)" if filled.database.is_sqlite else "decode('00', 'hex')"
    attacker(f"UPDATE audit_log SET {name} = {value if name == 'mac' else repr('x')} "
             "WHERE sequence = 3")  # fmt: skip
    assert problem(filled) == (3, "altered")


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("value", ["x'00'", "1.5", "7"])
def test_sqlite_values_of_no_type_of_ours_are_named_and_not_stumbled_over(
    filled: TemplateStore, attacker: Callable[..., object], value: str
) -> None:
    for name in ("mac", "tenant"):
        attacker(f"UPDATE audit_log SET {name} = {value} WHERE sequence = 5")
        assert problem(filled) == (5, "altered")
    attacker(f"UPDATE audit_log SET at = {value} WHERE sequence = 2")
    with pytest.raises(StoreError, match="line 2 of the audit log was altered"):
        list(filled.audit_log.lines())
    attacker(f"UPDATE audit_head SET mac = {value}")
    assert problem(filled) == (0, "head does not match")


def test_a_broken_head_is_not_built_upon(
    filled: TemplateStore, attacker: Callable[..., object]
) -> None:
    attacker("UPDATE audit_head SET sequence = 7")
    with pytest.raises(BrokenAuditLog):
        put(filled, "ada", b"wire")
    assert execute(filled.database, sa.select(SubjectRow.id)) == []


def test_a_log_that_was_put_back_is_found_with_an_anchor_only(
    filled: TemplateStore, attacker: Callable[..., object]
) -> None:
    early = filled.audit_log.head()
    attacker("CREATE TABLE kept AS SELECT * FROM audit_head")
    filled.audit_log.record(entry(9))
    late = filled.audit_log.head()
    assert (problem(filled, early), problem(filled, late)) == (None, None)
    attacker(
        "DELETE FROM audit_log WHERE sequence = 9",
        "DELETE FROM audit_head",
        "INSERT INTO audit_head SELECT * FROM kept",
    )
    assert problem(filled) is None
    assert problem(filled, late) == (9, "anchor not in chain")
    filled.audit_log.record(entry(10))  # another history, as long as the first
    assert problem(filled, early) is None
    assert problem(filled, late) == (9, "anchor not in chain")


@pytest.mark.parametrize(
    ("name", "and_head"), [*((name, False) for name in SecretName), (SecretName.LIFTS, True)]
)
def test_no_secret_is_made_anew_once_the_log_began(
    filled: TemplateStore,
    attacker: Callable[..., object],
    database_url: str,
    keyring: MasterKeyring,
    name: SecretName,
    and_head: bool,
) -> None:
    attacker(f"DELETE FROM secrets WHERE name = '{name}'")
    if and_head:
        attacker("DELETE FROM audit_head")
    fresh = TemplateStore(database_url, keyring)
    with pytest.raises(BrokenAuditLog, match=f"{name}.* backup"):
        fresh.upgrade()
    with pytest.raises(StoreError, match="no secret"):
        fresh.secrets.get(name)
    fresh.close()


# --- the archive ---------------------------------------------------------------------------


def test_old_lines_move_into_a_signed_file(filled: TemplateStore, tmp_path: Path) -> None:
    anchors = [START, *(Anchor(line.sequence, line.mac) for line in filled.audit_log.lines())]
    first, second = tmp_path / "first.jsonl", tmp_path / "second.jsonl"
    by = By("operator:root")
    one = archive_audit_log(filled, first, through=5, by=by)
    assert (one.base, one.last, one.lines) == (START, anchors[5], 5)
    assert first.stat().st_mode & 0o777 == 0o600
    assert [line.sequence for line in filled.audit_log.lines()] == [6, 7, 8, 9]
    assert problem(filled, anchors[7]) is None
    assert problem(filled, anchors[5]) is None
    assert problem(filled, anchors[3]) == (3, "anchor not in chain")
    two = archive_audit_log(filled, second, through=None, by=by)
    assert (two.base, two.last.sequence, two.lines) == (one.last, 9, 4)
    (line,) = filled.audit_log.lines()
    assert (line.action, line.actor, line.detail) == ("audit-archive", "operator:root", "6-9")
    assert problem(filled) is None
    public_key = filled.signer.public_key()
    assert [verify_archive(file, public_key) for file in (first, second)] == [one, two]
    kept = [json.loads(text) for text in first.read_text().splitlines()[1:]]
    assert [each["sequence"] for each in kept] == [1, 2, 3, 4, 5]
    assert kept[-1]["mac"] == anchors[5].mac.hex()


def test_the_line_of_a_token_stays_until_the_token_is_too_late(
    filled: TemplateStore, clock: Clock, tmp_path: Path
) -> None:
    """Without it, the token would be good once more."""
    filled.audit_log.record(Entry("verify", "accept", By(), tenant="default", token=TOKEN))
    filled.audit_log.record(entry(LINES + 2))
    assert archive_audit_log(filled, tmp_path / "early", through=None).last.sequence == LINES
    clock.pass_by(minutes=11)
    assert archive_audit_log(filled, tmp_path / "late", through=None).last.sequence == LINES + 3


def test_an_archive_that_was_altered_or_is_none_is_refused(
    filled: TemplateStore, tmp_path: Path
) -> None:
    file = tmp_path / "audit.jsonl"
    archive_audit_log(filled, file, through=None)
    data, public_key = file.read_bytes(), filled.signer.public_key()
    first, _, rest = data.partition(b"\n")
    for altered in (
        data.replace(b"locked_out", b"accept", 1),
        data.replace(b"lines", b"limes", 1),
        first + b"\n" + rest[: rest.rindex(b"{")],
        data + b"\n",
        b"",
        b"[]\n",
        b"{}\n",
    ):
        file.write_bytes(altered)
        with pytest.raises(StoreError, match="no archive of this deployment"):
            verify_archive(file, public_key)
    file.write_bytes(data)
    with pytest.raises(StoreError):
        verify_archive(file, bytes(32))
    with pytest.raises(StoreError, match="cannot be read"):
        verify_archive(tmp_path / "none", public_key)


def test_nothing_is_archived_that_cannot_be_vouched_for_or_kept(
    filled: TemplateStore, attacker: Callable[..., object], tmp_path: Path
) -> None:
    taken = tmp_path / "taken"
    taken.write_bytes(b"mine")
    with pytest.raises(StoreError, match="cannot be written"):
        archive_audit_log(filled, taken, through=None)
    with pytest.raises(StoreError, match="no line"):
        archive_audit_log(filled, tmp_path / "empty", through=0)
    assert taken.read_bytes() == b"mine"
    attacker("UPDATE audit_log SET outcome = 'accept' WHERE sequence = 5")
    with pytest.raises(BrokenAuditLog, match="line 5"):
        archive_audit_log(filled, tmp_path / "altered", through=None)
    assert len(list(filled.audit_log.lines())) == LINES
    assert not (tmp_path / "altered").exists()
    assert archive_audit_log(filled, tmp_path / "before", through=4).lines == 4


# --- many at once --------------------------------------------------------------------------


def test_processes_append_to_one_chain(store: TemplateStore) -> None:
    def work(output: TextIO) -> None:
        for number in range(25):
            store.audit_log.record(entry(number))
        print("done", file=output)

    assert list(in_processes(work, store, 4)) == ["done\n"] * 4
    assert [line.sequence for line in store.audit_log.lines()] == list(range(1, 101))
    assert verify_audit_log(store).intact
