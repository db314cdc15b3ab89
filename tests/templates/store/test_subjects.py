import base64
import random
import re
import unicodedata
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from hypothesis import example, given
from hypothesis import strategies as st

from templates.errors import SealError, StoreUnavailable
from templates.keys.sealing import MasterKeyring
from templates.store import InvalidIdentifier, Source, TemplateStore
from templates.store.identifiers import checked_subject_id
from templates.store.schema import SubjectRow
from templates.store.subjects import EnrollmentConflict, Precondition
from tests.databases import execute
from tests.templates.store.conftest import CONTRACT, Clock, put, wire_of


def test_put_then_get(store: TemplateStore, clock: Clock) -> None:
    replaced = store.subjects.put(
        "default",
        "ada@example.org",
        b"wire bytes",
        contract_id=CONTRACT,
        source=Source.TEMPLATE,
        photos=0,
        template_id="t-1",
    )
    assert not replaced
    found = store.subjects.get("default", "ada@example.org")
    assert found is not None
    assert found.wire == b"wire bytes"
    record = found.record
    assert (record.subject_id, record.template_id, record.contract_id) == (
        "ada@example.org",
        "t-1",
        CONTRACT,
    )
    assert (record.source, record.photos, record.rotation_epoch) == (Source.TEMPLATE, 0, 1)
    assert record.created_at == record.updated_at == clock.time


def test_replacing_keeps_the_first_date_and_forgets_the_rest(
    store: TemplateStore, clock: Clock
) -> None:
    assert not put(store, "ada", b"old", contract_id="a" * 64)
    (before,) = rows(store).values()
    clock.pass_by(days=3)
    assert put(store, "ada", b"new")
    assert wire_of(store, "ada") == b"new"
    record = store.subjects.describe("default", "ada")
    assert record is not None
    assert record.contract_id == CONTRACT
    assert (record.updated_at - record.created_at).days == 3
    (after,) = rows(store).values()
    assert before.wrapped_key != after.wrapped_key
    assert before.ciphertext != after.ciphertext


def test_what_is_committed_is_not_reported_as_failed(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    store = TemplateStore(f"sqlite:///{tmp_path / 'veilface.db'}", keyring)
    store.upgrade()
    store.tenants.create("default")
    put(store, "ada", b"first")
    fails = False

    def fail(*_: object) -> None:
        nonlocal fails
        if fails:
            fails = False
            raise StoreUnavailable("all connections to the database are busy")

    def after_a_commit(*_: object) -> None:
        nonlocal fails
        fails = True

    sa.event.listen(store.database.engine, "checkout", fail)
    sa.event.listen(store.database.engine, "commit", after_a_commit)
    assert put(store, "ada", b"second")
    assert wire_of(store, "ada") == b"second"
    erasure = store.erasures.erase("default", "ada")
    assert (erasure.erased, erasure.log_purged) == (True, False)
    store.close()


INVISIBLE_NAMES = re.compile("HANGUL.* FILLER|VARIATION SELECTOR|GRAPHEME JOINER|VOWEL INHERENT")


@given(st.text(max_size=6))
@example(".")
@example("..")
@example("...")
@example("a\u3164")
@example("a\u034f\ufe0f")
@example("\N{ARABIC-INDIC DIGIT THREE}")
@example("\N{CIRCLED DIGIT ONE}")
@example("\N{VULGAR FRACTION ONE HALF}")
@example("\N{ROMAN NUMERAL FOUR}")
def test_subject_ids_keep_to_the_rule(text: str) -> None:
    normal = unicodedata.normalize("NFC", text)
    marks = {"Mn", "Mc", "Me"}
    if text not in ("", ".", "..") and all(
        (
            character.isalpha()
            or character.isdecimal()
            or character in "._@:-"
            or unicodedata.category(character) in marks
        )
        and not INVISIBLE_NAMES.search(unicodedata.name(character, ""))
        for character in normal
    ):
        assert checked_subject_id(text) == normal == checked_subject_id(normal)
    else:
        with pytest.raises(InvalidIdentifier, match="1 to 128 characters"):
            checked_subject_id(text)


def test_a_bad_subject_id_is_refused_everywhere(store: TemplateStore) -> None:
    calls = (
        lambda bad: put(store, bad, b"wire"),
        lambda bad: store.subjects.get("default", bad),
        lambda bad: store.subjects.describe("default", bad),
        lambda bad: store.erasures.erase("default", bad),
        lambda bad: store.erasures.receipt("default", bad),
    )
    for call in calls:
        for bad in ("", "x" * 129, "a b", "a/b", "a\N{ZERO WIDTH SPACE}", "\ud800", "a\x00", ".."):
            with pytest.raises(InvalidIdentifier):
                call(bad)


def rows(store: TemplateStore) -> dict[tuple[str, str], Any]:
    """What stands in the database, by tenant id and subject id."""
    found = execute(store.database, sa.select(SubjectRow.__table__))
    return {(row.tenant_id, row.subject_id): row for row in found}


def change(store: TemplateStore, who: str, **values: object) -> None:
    """Alter columns of a subject of the default tenant, as a thief in the database would."""
    theirs = SubjectRow.tenant_id == store.tenants.get("default").id
    changed = sa.update(SubjectRow).where(theirs, SubjectRow.subject_id == who)
    execute(store.database, changed.values(values))


def test_the_database_holds_no_plaintext(store: TemplateStore) -> None:
    wire = random.Random(1).randbytes(9000)
    put(store, "ada", wire)
    (row,) = rows(store).values()
    for stored in (row.ciphertext, row.wrapped_key):
        assert not any(wire[i : i + 8] in stored for i in range(0, len(wire), 8))


@pytest.mark.parametrize(
    ("tenant", "subject", "columns"),
    [
        ("default", "eve", ["ciphertext"]),
        ("default", "eve", ["wrapped_key"]),
        ("default", "eve", ["ciphertext", "wrapped_key"]),
        ("other", "ada", ["ciphertext"]),
        ("other", "ada", ["ciphertext", "wrapped_key"]),
    ],
)
def test_a_row_moved_in_the_database_does_not_open(
    store: TemplateStore, tenant: str, subject: str, columns: list[str]
) -> None:
    put(store, "ada", b"wire of ada", template_id="same")
    put(store, subject, b"another wire", tenant=tenant, template_id="same")
    source = rows(store)[store.tenants.get(tenant).id, subject]
    change(store, "ada", **{column: getattr(source, column) for column in columns})
    with pytest.raises(SealError, match="does not open"):
        store.subjects.get("default", "ada")
    # The control: nothing else was wrong.
    assert wire_of(store, subject, tenant=tenant) == b"another wire"


@pytest.mark.parametrize(
    "altered",
    [
        {"contract_id": "d" * 64},
        {"template_id": "t-2"},
        {"rotation_epoch": 2},
        {"ciphertext": b""},
        {"ciphertext": b"\x02" * 60},
        {"wrapped_key": b""},
        {"holder_salt": "ab" * 16},
    ],
)
def test_a_row_relabelled_in_the_database_does_not_open(
    store: TemplateStore, altered: dict[str, object]
) -> None:
    put(store, "ada", b"wire", template_id="t-1")
    change(store, "ada", **altered)
    with pytest.raises(SealError):
        store.subjects.get("default", "ada")


def test_a_row_given_to_another_subject_or_tenant_does_not_open(store: TemplateStore) -> None:
    for name in ("ada", "eve"):
        put(store, name, b"wire")
    change(store, "ada", tenant_id=store.tenants.get("other").id)
    change(store, "eve", subject_id="ada")
    for tenant in ("default", "other"):
        with pytest.raises(SealError):
            store.subjects.get(tenant, "ada")


def test_a_subject_under_another_row_id_does_not_open(store: TemplateStore) -> None:
    """An old row put back after an erasure opens no more under the subject's new row."""
    put(store, "ada", b"first")
    (old,) = rows(store).values()
    store.erasures.erase("default", "ada")
    put(store, "ada", b"second")
    change(store, "ada", wrapped_key=old.wrapped_key, ciphertext=old.ciphertext)
    with pytest.raises(SealError):
        store.subjects.get("default", "ada")


def test_pages_hold_every_subject_once_in_order(store: TemplateStore) -> None:
    names = ["b", "B", "a", "Z", "z9", "z10", "a.b", "a-b", "a_b", "a:b", "a@b", "0"]
    for name in names:
        put(store, name, b"wire")
    seen, cursor, pages = [], None, 0
    while True:
        page = store.subjects.list("default", limit=4, cursor=cursor)
        seen += [record.subject_id for record in page.records]
        pages += 1
        if (cursor := page.next_cursor) is None:
            break
    assert seen == sorted(names)  # by code point, whatever the database's language
    assert pages == 3
    for prefix in ("a", "a.", "z1", "Z", "q", "a" * 128):
        records = store.subjects.list("default", prefix=prefix).records
        begin = [name for name in sorted(names) if name.startswith(prefix)]
        assert [record.subject_id for record in records] == begin, prefix
    first = store.subjects.list("default", prefix="a", limit=4)
    rest = store.subjects.list("default", prefix="a", cursor=first.next_cursor)
    assert [each.subject_id for each in rest.records] == ["a:b", "a@b", "a_b"][-2:]
    for bad in ("a/b", "%", "a\0", "a\x7f", "a" * 129):
        with pytest.raises(InvalidIdentifier, match="begins with"):
            store.subjects.list("default", prefix=bad)


def test_pages_are_stable_while_others_write(store: TemplateStore) -> None:
    stay = [f"s{number:02d}" for number in range(0, 40, 2)]
    for name in stay:
        put(store, name, b"wire")
    generator, seen, cursor = random.Random(2), [], None
    while True:
        page = store.subjects.list("default", limit=3, cursor=cursor)
        seen += [record.subject_id for record in page.records]
        for _ in range(3):
            name = f"s{generator.randrange(1, 40, 2):02d}"
            if generator.random() < 0.5:
                put(store, name, b"wire")
            else:
                store.erasures.erase("default", name)
        if page.next_cursor is None:
            break
        cursor = page.next_cursor
    assert [name for name in seen if name in stay] == stay
    assert len(seen) == len(set(seen))


def test_a_cursor_shows_nothing_and_cannot_be_made(store: TemplateStore) -> None:
    for name in ("ada", "eve"):
        put(store, name, b"wire")
        put(store, name, b"wire", tenant="other")
    cursor = store.subjects.list("default", limit=1).next_cursor
    assert cursor is not None
    raw = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
    assert b"ada" not in raw
    altered = cursor[:-2] + ("AA" if cursor[-2:] != "AA" else "BB")
    for bad in (altered, cursor[:10], "", "ada", "ä", "x" * 1000):
        with pytest.raises(InvalidIdentifier, match="cursor"):
            store.subjects.list("default", cursor=bad)
    with pytest.raises(InvalidIdentifier, match="cursor"):
        store.subjects.list("other", cursor=cursor)
    for limit in (0, -1, 1001):
        with pytest.raises(InvalidIdentifier, match="limit"):
            store.subjects.list("default", limit=limit)


def test_of_processes_that_enroll_at_once_one_does(
    store: TemplateStore, database_url: str, key_file: Path
) -> None:
    """Each thread has a store of its own, as each worker of a service has."""
    stores = [store, *(TemplateStore(database_url, MasterKeyring.load(key_file)) for _ in range(3))]

    def enroll(number: int, named: str | None) -> bool:
        try:
            put(stores[number % 4], "ann", bytes([number]), precondition=Precondition(named))
        except EnrollmentConflict:
            return False
        return True

    try:
        named: str | None = None
        for _ in range(5):
            with ThreadPoolExecutor(8) as threads:
                enrolled = list(threads.map(enroll, range(1, 9), [named] * 8))
            assert sum(enrolled) == 1
            template = store.subjects.get("default", "ann")
            assert template.wire == bytes([1 + enrolled.index(True)])
            named = template.template_id
    finally:
        for other in stores[1:]:
            other.close()
