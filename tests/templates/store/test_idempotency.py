import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store import (
    Answer,
    Claim,
    IdempotencyConflict,
    Storage,
    TemplateStore,
    UnknownTenant,
    idempotency,
)
from templates.store.database import Database
from templates.store.idempotency import Idempotency
from templates.store.schema import IdempotencyRow
from templates.store.subjects import EnrollmentConflict, Once, Precondition, StoredTemplate
from tests.patience import PATIENCE_S, wait_until
from tests.templates.store.conftest import Clock, finish, put, template_id


def claim(store: TemplateStore, key: str = "k", request: bytes = b"r", **more: str) -> Claim:
    claimed = store.idempotency.claim("default", actor="key 1", key=key, request=request, **more)
    assert isinstance(claimed, Claim)
    return claimed


def answer(store: TemplateStore, key: str = "k", request: bytes = b"r") -> Answer:
    given = store.idempotency.claim("default", actor="key 1", key=key, request=request)
    assert isinstance(given, Answer)
    return given


def test_a_repeated_request_gets_the_first_answer(store: TemplateStore) -> None:
    finish(store, claim(store), status=201, body=b'{"ok":true}')
    assert answer(store) == answer(store) == Answer(201, b'{"ok":true}')


def test_another_request_with_the_key_is_a_conflict(store: TemplateStore) -> None:
    finish(store, claim(store), status=201, body=b"")
    with pytest.raises(IdempotencyConflict, match="another request"):
        claim(store, request=b"something else")


def test_keys_belong_to_an_actor_and_a_tenant(store: TemplateStore) -> None:
    claim(store)
    for tenant, actor in (("default", "key 2"), ("other", "key 1")):
        claimed = store.idempotency.claim(tenant, actor=actor, key="k", request=b"other")
        assert isinstance(claimed, Claim)


def test_a_running_request_is_a_conflict_until_its_claim_lapses(
    store: TemplateStore, clock: Clock
) -> None:
    dead = claim(store)
    clock.pass_by(seconds=59)
    with pytest.raises(IdempotencyConflict, match="still running"):
        claim(store)
    clock.pass_by(seconds=1)
    alive = claim(store)
    with pytest.raises(IdempotencyConflict, match="taken over"):
        finish(store, dead, status=500, body=b"late")
    finish(store, alive, status=200, body=b"alive")
    assert answer(store).body == b"alive"


def test_a_released_key_is_free(store: TemplateStore) -> None:
    store.idempotency.release(claim(store))
    again = claim(store, request=b"other")
    finish(store, again, status=200, body=b"")
    store.idempotency.release(again)  # an answer stays
    assert answer(store, request=b"other").status == 200


def test_answers_are_kept_for_a_day(store: TemplateStore, clock: Clock) -> None:
    finish(store, claim(store), status=200, body=b"")
    clock.pass_by(hours=23)
    claim(store, key="later")
    assert store.idempotency.expire() == 0
    clock.pass_by(hours=1)
    assert store.idempotency.expire() == 1
    claim(store, request=b"anything")


def test_erasing_the_subject_takes_its_records_and_late_answers(store: TemplateStore) -> None:
    done = claim(store, key="done", subject_id="ada")
    finish(store, done, status=201, body=b"about ada")
    running = claim(store, key="running", subject_id="ada")
    finish(store, claim(store, key="eve", subject_id="eve"), status=201, body=b"eve")
    store.erasures.erase("default", "ada")
    with pytest.raises(IdempotencyConflict, match="erased meanwhile"):
        finish(store, running, status=201, body=b"about ada")
    for key in ("done", "running"):
        claim(store, key=key)
    assert answer(store, key="eve").body == b"eve"


def test_key_and_request_are_stored_as_keyed_hashes(
    store: TemplateStore, database_url: str
) -> None:
    # No hexadecimal digits: a name made of them would stand in some pseudonym by chance.
    claim(store, key="enroll-zygmunt", request=b"digest of a photo", subject_id="zygmunt")
    database = Database(database_url)
    row = database.read(lambda each: each.execute(sa.select(IdempotencyRow)).one())
    stored = b"|".join(v if isinstance(v, bytes) else str(v).encode() for v in row)
    for plain in (b"enroll-zygmunt", b"digest of a photo", b"zygmunt"):
        assert plain not in stored
    assert row.pseudonym == store.signer.pseudonym("default", "zygmunt")
    database.close()


def test_of_many_at_once_one_runs(store: TemplateStore) -> None:
    outcomes: list[str] = []
    start = threading.Barrier(8)

    def request() -> None:
        start.wait()
        try:
            outcomes.append(type(store.idempotency.claim(*args, **named)).__name__)
        except IdempotencyConflict:
            outcomes.append("conflict")

    args, named = ("default",), {"actor": "key 1", "key": "k", "request": b"r"}
    threads = [threading.Thread(target=request) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcomes) == ["Claim"] + ["conflict"] * 7


def test_nonsense_is_refused(store: TemplateStore) -> None:
    for key in ("", "x" * 256):
        with pytest.raises(StoreError, match="1 to 255"):
            claim(store, key=key)
    with pytest.raises(UnknownTenant):
        store.idempotency.claim("nobody", actor="a", key="k", request=b"")
    with pytest.raises(StoreError, match="not kept"):
        finish(store, claim(store), status=200, body=bytes(65 * 1024))


def test_many_expired_records_go_in_small_transactions(
    store: TemplateStore, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(idempotency, "BATCH", 3)
    for number in range(8):
        claim(store, key=f"k{number}")
    clock.pass_by(hours=25)
    claim(store, key="young")
    sizes: list[int] = []
    write = store.database.write

    def counted(work: Any, **named: Any) -> Any:
        sizes.append(write(work, **named))
        return sizes[-1]

    monkeypatch.setattr(store.database, "write", counted)
    assert store.idempotency.expire() == 8
    assert sizes == [3, 3, 2]
    assert store.idempotency.expire() == 0
    assert sizes == [3, 3, 2]


NEVER = Precondition(None)


def once(claimed: Claim) -> Once:
    """Answer with the template's id."""

    def answered(stored: StoredTemplate) -> Answer:
        return Answer(201 if stored.created else 200, stored.template_id.encode())

    return Once(claimed, answered)


def test_an_enrollment_leaves_its_answer_in_its_own_transaction(
    store: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = put(store, "ada", b"wire", precondition=NEVER, once=once(claim(store)))
    assert answer(store) == Answer(201, first.template_id.encode())
    # Neither is there where the transaction does not come to its end.
    running = claim(store, key="other")

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(type(store.idempotency), "_leave", fail)
        with pytest.raises(KeyboardInterrupt):
            put(store, "eve", b"wire", precondition=NEVER, once=once(running))
    assert template_id(store, "eve") is None
    with pytest.raises(IdempotencyConflict, match="still running"):
        claim(store, key="other")
    store.idempotency.release(running)
    put(store, "eve", b"wire", precondition=NEVER, once=once(claim(store, key="other")))
    # What a commit whose news was lost has left is not given back.
    store.idempotency.release(running)
    assert answer(store, key="other").status == 201


def test_a_run_that_was_taken_over_writes_nothing(store: TemplateStore, clock: Clock) -> None:
    """It stood still for more than a minute, and the client's next try went ahead."""
    late = claim(store)
    clock.pass_by(minutes=1)
    first = put(store, "ada", b"wire", once=once(claim(store)))
    with pytest.raises(IdempotencyConflict, match="taken over"):
        put(store, "ada", b"wire", once=once(late))
    assert template_id(store, "ada") == first.template_id
    assert answer(store).body == first.template_id.encode()


@pytest.mark.parametrize("storage", Storage)
def test_a_run_whose_record_is_gone_writes_nothing(
    store: TemplateStore, clock: Clock, storage: Storage
) -> None:
    """Or the next try would meet its own enrollment, or somebody stay enrolled who was erased."""
    late = claim(store)
    clock.pass_by(minutes=1)
    store.idempotency.release(claim(store))  # the next try failed
    erased = claim(store, key="erased", subject_id="ada")
    store.erasures.erase("default", "ada")
    for gone in (late, erased):
        with pytest.raises(IdempotencyConflict, match="meanwhile"):
            put(store, "ada", b"wire", storage=storage, once=once(gone))
    assert template_id(store, "ada") is None
    assert put(store, "ada", b"wire", precondition=NEVER, once=once(claim(store))).created


def test_a_note_that_is_left_while_its_record_is_claimed_is_found(
    store: TemplateStore, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first run stood still for a minute, and commits while the next one claims."""
    if store.database.is_sqlite:
        pytest.skip("writes wait for each other")
    running = claim(store)
    clock.pass_by(minutes=1)
    noted, go_on = threading.Event(), threading.Event()
    note_written = Idempotency.note_written

    def held(*given: Any) -> None:
        note_written(*given)
        noted.set()
        go_on.wait(PATIENCE_S)

    monkeypatch.setattr(Idempotency, "note_written", held)
    more = {"storage": Storage.HOLDER, "precondition": NEVER}
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(put, store, "ada", b"wire", once=once(running), **more)
        try:
            assert noted.wait(PATIENCE_S)
            again = threads.submit(claim, store)
            wait_until(lambda: store.database.read(_waits))
        finally:
            go_on.set()
        next_run = again.result()
    assert next_run.written == first.result().template_id
    assert not put(store, "ada", b"wire", once=once(next_run), **more).created


def _waits(connection: Connection) -> bool:
    """Whether a transaction of this database waits for another one's row."""
    waiting = sa.text(
        "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() "
        "AND wait_event_type = 'Lock'"
    )
    return connection.execute(waiting).scalar_one() > 0


def test_the_next_run_may_replace_a_held_template_that_an_earlier_one_wrote(
    store: TemplateStore,
) -> None:
    """Whatever the precondition: the answer with the template was lost, and is not kept."""

    def hold(key: str, request: bytes = b"r") -> StoredTemplate:
        claimed = claim(store, key=key, request=request)
        held = {"storage": Storage.HOLDER, "precondition": NEVER, "once": once(claimed)}
        try:
            return put(store, "ada", b"wire", **held)
        except EnrollmentConflict:
            store.idempotency.release(claimed)
            raise

    first = hold("k")
    # A try that does not come to its end leaves the note of the one before.
    lost = claim(store)
    assert lost.written == first.template_id
    with pytest.raises(IdempotencyConflict, match="still running"):
        claim(store)
    store.idempotency.release(lost)
    second = hold("k")
    assert (second.created, template_id(store, "ada")) == (False, second.template_id)
    # Another request has no part in it, nor has this one once something else was written.
    with pytest.raises(EnrollmentConflict):
        hold("another key")
    other = put(store, "ada", b"wire")
    with pytest.raises(EnrollmentConflict):
        hold("k")
    assert template_id(store, "ada") == other.template_id
    with pytest.raises(EnrollmentConflict):
        hold("k", request=b"another request")


def test_a_note_that_somebody_else_wrote_is_none(store: TemplateStore) -> None:
    """Or who writes the database would have another's template replaced."""
    put(store, "ada", b"wire", storage=Storage.HOLDER, once=once(claim(store)))
    forged = sa.update(IdempotencyRow).values(body=b"0" * 32)
    store.database.write(lambda connection: connection.execute(forged))
    assert claim(store).written is None
