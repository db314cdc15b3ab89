"""Failed attempts, the lock that follows them, and nonces."""

import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TextIO

import pytest
import sqlalchemy as sa

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import (
    Attempt,
    AttemptsStatus,
    By,
    LockedOut,
    LockoutPolicy,
    Nonce,
    Replayed,
    Superseded,
    TemplateStore,
    UnknownTenant,
)
from templates.store.attempt_queries import before
from templates.store.schema import FailedAttemptsRow, SubjectRow, UsedNonceRow
from tests.templates.store.conftest import CONTRACT, Clock, put, template_id
from tests.templates.store.test_concurrency import fork

BY = By("key:00112233aabb", "request-12345678")

# The children do nothing but use the store; threads that other tests left behind are not theirs.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")


def attempt(
    store: TemplateStore,
    subject: str = "ada",
    *,
    accepted: bool = False,
    nonce: Nonce | None = None,
    known: bool = True,
) -> str:
    """What the client of one verification is told; "superseded" is decided again."""
    decided_on = template_id(store, subject) if known else None
    try:
        store.attempts.conclude(
            "default",
            subject,
            accepted=accepted,
            template_id=decided_on,
            level="high",
            nonce=nonce,
            by=BY,
        )
    except LockedOut as error:
        return "disabled" if error.retry_after_s is None else f"locked {error.retry_after_s:g}"
    except Replayed:
        return "replayed"
    except Superseded:
        return "superseded"
    return "accept" if accepted else "reject"


def test_a_subject_without_a_template_costs_as_many_bytes(store: TemplateStore) -> None:
    """Else the time tells who is enrolled. Of several, not always the same; none where none is."""

    def read(subject: str) -> list[bytes]:
        """The long values of the one row that an attempt reads."""
        asked = store.attempts._asked("default", subject, None, CONTRACT)
        query = before(len(asked["pseudonyms"]))
        row = store.database.read(lambda connection: connection.execute(query, asked).one())
        return [bytes(value) for value in row if isinstance(value, bytes) and len(value) > 1000]

    assert read("nobody") == []
    enrolled = [f"person-{number}" for number in range(8)]
    for subject in enrolled:
        put(store, subject, bytes(5000))
    own = {ciphertext for subject in enrolled for ciphertext in read(subject)}
    assert len(own) == len(enrolled)
    others = [read(subject) for subject in (f"nobody-{number}" for number in range(40))]
    assert {len(each) for each in others} == {1}
    assert len({ciphertext for (ciphertext,) in others} & own) > 1
    assert read("nobody-1") == read("nobody-1")


def conclude(
    store: TemplateStore,
    decided_on: str | None,
    *,
    accepted: bool = True,
    contract_id: str | None = None,
    nonce: Nonce | None = None,
    tenant: str = "default",
) -> None:
    """Conclude a decision about ada on this template."""
    store.attempts.conclude(
        tenant,
        "ada",
        accepted=accepted,
        template_id=decided_on,
        contract_id=contract_id,
        level="high",
        nonce=nonce,
        by=BY,
    )


def begin(store: TemplateStore, *, tenant: str = "default", nonce: Nonce | None = None) -> Attempt:
    """Begin an attempt on ada."""
    return store.attempts.begin(tenant, "ada", contract_id=CONTRACT, nonce=nonce)


def status(store: TemplateStore, subject: str = "ada") -> AttemptsStatus:
    found = store.attempts.status("default", subject)
    assert found is not None
    return found


def count(store: TemplateStore, table: type) -> int:
    query = sa.select(sa.func.count()).select_from(table)
    return store.database.read(lambda each: each.execute(query).scalar_one())


@pytest.fixture
def ada(store: TemplateStore) -> TemplateStore:
    """A store in which ada is enrolled, and nobody else."""
    put(store, "ada", b"wire")
    return store


# --- the lock ------------------------------------------------------------------------------


def test_the_lock_grows_up_to_the_longest_and_then_disables(
    ada: TemplateStore, clock: Clock
) -> None:
    expected = {5: 30, 6: 60, 7: 120, 8: 240, 9: 480, 10: 960, 11: 1920, 12: 3600, 13: 3600}
    for number in range(1, 51):
        assert attempt(ada) == "reject", number
        found = status(ada)
        assert found.consecutive == found.total == number
        assert found.last_failed_at == clock.time
        if number < 5:
            assert found.locked_until is None
            begin(ada)
            continue
        seconds = expected.get(number, 3600)
        assert found.locked_until == clock.time + timedelta(seconds=seconds)
        if number == 50:
            break
        assert attempt(ada, accepted=True) == f"locked {seconds}"
        clock.pass_by(seconds=seconds - 0.25)
        assert attempt(ada) == "locked 0.25"
        assert status(ada).consecutive == number  # nothing is counted meanwhile
        clock.pass_by(seconds=0.25)
        begin(ada)
    assert status(ada).disabled_at == clock.time
    clock.pass_by(days=1000)
    assert attempt(ada, accepted=True) == "disabled"
    with pytest.raises(LockedOut, match="until an operator resets it") as raised:
        begin(ada)
    assert raised.value.retry_after_s is None


def test_the_check_tells_how_long(ada: TemplateStore, clock: Clock) -> None:
    for _ in range(5):
        attempt(ada)
    clock.pass_by(seconds=10)
    with pytest.raises(LockedOut, match="try again in 20 s") as raised:
        begin(ada)
    assert raised.value.retry_after_s == 20
    assert not raised.value.recorded
    lines = len(list(ada.audit_log.lines()))
    with pytest.raises(LockedOut) as again:
        conclude(ada, template_id(ada, "ada"))
    assert again.value.recorded
    assert len(list(ada.audit_log.lines())) == lines + 1


def test_a_clock_that_is_set_back_prolongs_no_lock_by_more_than_its_length(
    ada: TemplateStore, clock: Clock
) -> None:
    for _ in range(5):
        attempt(ada)
    clock.pass_by(seconds=-29)
    assert attempt(ada) == "locked 59"
    clock.pass_by(days=-1)
    assert attempt(ada) == "reject"
    assert attempt(ada) == "locked 60"
    clock.pass_by(seconds=60)
    assert attempt(ada, accepted=True) == "accept"


def test_an_accept_clears_the_count_and_notes_the_use(ada: TemplateStore, clock: Clock) -> None:
    used = sa.select(SubjectRow.last_used_at)
    for _ in range(4):
        assert attempt(ada) == "reject"
    assert ada.database.read(lambda each: each.execute(used).scalar_one()) is None
    assert attempt(ada, accepted=True) == "accept"
    assert ada.database.read(lambda each: each.execute(used).scalar_one()) == clock.time
    assert (status(ada).consecutive, status(ada).total) == (0, 4)
    for _ in range(4):
        assert attempt(ada) == "reject"
    assert attempt(ada, accepted=True) == "accept"


def test_an_accept_of_who_never_failed_counts_nothing(ada: TemplateStore) -> None:
    assert attempt(ada, accepted=True) == "accept"
    assert ada.attempts.status("default", "ada") is None


def test_subjects_are_counted_apart_and_never_the_key(ada: TemplateStore) -> None:
    put(ada, "eve", b"wire")
    for _ in range(5):
        attempt(ada)
    assert attempt(ada) == "locked 30"
    assert attempt(ada, "eve", accepted=True) == "accept"
    begin(ada, tenant="other")


def test_who_is_not_enrolled_is_counted_and_locked_alike(ada: TemplateStore) -> None:
    for number in range(5):
        assert attempt(ada) == attempt(ada, "nobody", known=False) == "reject", number
    assert attempt(ada) == attempt(ada, "nobody", known=False) == "locked 30"
    one, other = status(ada), status(ada, "nobody")
    assert one == other


def test_who_is_not_enrolled_is_never_accepted(ada: TemplateStore) -> None:
    with pytest.raises(ValueError, match="not enrolled"):
        attempt(ada, accepted=True, known=False)


def test_an_unknown_tenant_is_named(ada: TemplateStore) -> None:
    with pytest.raises(UnknownTenant):
        conclude(ada, None, accepted=False, tenant="nowhere")


def test_without_a_lockout_failures_are_counted_only(
    database_url: str, keyring: MasterKeyring, ada: TemplateStore
) -> None:
    free = TemplateStore(database_url, keyring, lockout=LockoutPolicy(after=0))
    for _ in range(60):
        assert attempt(free) == "reject"
    assert status(free).consecutive == 60
    assert (status(free).locked_until, status(free).disabled_at) == (None, None)
    assert attempt(free, accepted=True) == "accept"
    free.close()


def test_a_policy_of_ones_own(
    database_url: str, keyring: MasterKeyring, ada: TemplateStore
) -> None:
    policy = LockoutPolicy(after=1, first_s=2, longest_s=3, disable_at=2)
    strict = TemplateStore(database_url, keyring, lockout=policy, clock=ada._context.clock)
    assert attempt(strict) == "reject"
    assert attempt(strict) == "locked 2"
    strict.close()


@pytest.mark.parametrize(
    "change",
    [{"after": -1}, {"first_s": 0}, {"first_s": 10, "longest_s": 9}, {"disable_at": 4}],
)
def test_a_policy_that_makes_no_sense_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(StoreError):
        LockoutPolicy(**change)  # type: ignore[arg-type]


def test_a_long_row_of_failures_does_not_overflow() -> None:
    policy = LockoutPolicy(disable_at=10**9)
    assert policy.lock(10**8) == timedelta(hours=1)


def test_a_restart_forgets_nothing(
    ada: TemplateStore, database_url: str, keyring: MasterKeyring, clock: Clock
) -> None:
    for _ in range(4):
        attempt(ada)
    again = TemplateStore(database_url, keyring, clock=clock)
    assert attempt(again) == "reject"
    assert attempt(ada) == attempt(again) == "locked 30"
    again.close()


# --- reset, erasure, expiry ----------------------------------------------------------------


def test_an_operator_resets(ada: TemplateStore, clock: Clock) -> None:
    by = By("operator:root")
    assert not ada.attempts.reset("default", "ada", by=by)
    for _ in range(50):
        assert attempt(ada) == "reject"
        clock.pass_by(hours=1)
    assert attempt(ada, accepted=True) == "disabled"
    assert ada.attempts.reset("default", "ada", by=by)
    assert not ada.attempts.reset("default", "ada", by=by)
    found = status(ada)
    assert (found.consecutive, found.total) == (0, 50)
    assert (found.locked_until, found.disabled_at) == (None, None)
    assert attempt(ada, accepted=True) == "accept"
    resets = [each for each in ada.audit_log.lines() if each.action == "lockout-reset"]
    assert [each.outcome for each in resets] == ["nothing_held", "reset", "nothing_held"]
    assert {each.actor for each in resets} == {"operator:root"}
    assert {each.pseudonym for each in resets} == {ada.signer.pseudonym("default", "ada")}


def test_an_erasure_takes_the_count_along_and_leaves_the_lines(ada: TemplateStore) -> None:
    for _ in range(5):
        attempt(ada)
    lines = len(list(ada.audit_log.lines()))
    counts = {
        each["item"]: each["count"]
        for each in ada.erasures.erase("default", "ada").receipt.claims["erased"]
    }
    assert counts["failed_attempts"] == 1
    assert ada.attempts.status("default", "ada") is None
    assert len(list(ada.audit_log.lines())) == lines + 1
    put(ada, "ada", b"wire")
    assert attempt(ada, accepted=True) == "accept"


def test_a_replacement_keeps_the_count(ada: TemplateStore) -> None:
    for _ in range(5):
        attempt(ada)
    put(ada, "ada", b"again")
    assert attempt(ada, accepted=True) == "locked 30"


def test_counts_of_who_is_not_enrolled_expire(ada: TemplateStore, clock: Clock) -> None:
    put(ada, "gone", b"wire")
    for name in ("ada", "nobody", "later", "gone"):
        attempt(ada, name, known=name in ("ada", "gone"))
    for _ in range(50):
        attempt(ada, "disabled", known=False)
        clock.pass_by(hours=1)
    put(ada, "later", b"wire")
    ada.erasures.erase("default", "gone")
    assert attempt(ada, "gone", known=False) == "reject"
    clock.pass_by(days=85)
    assert ada.attempts.expire() == 0
    attempt(ada, "fresh", known=False)
    clock.pass_by(days=5, seconds=1)
    assert ada.attempts.expire() == 2
    left = {name: ada.attempts.status("default", name) for name in ("nobody", "gone")}
    assert left == {"nobody": None, "gone": None}
    for name in ("ada", "later", "disabled", "fresh"):
        assert ada.attempts.status("default", name) is not None, name
    assert ada.purge()
    assert ada.attempts.expire() == 0


# --- decisions on what is no more ----------------------------------------------------------


def written(store: TemplateStore) -> tuple[object, ...]:
    """All that a conclusion writes."""
    return (
        store.audit_log.head(),
        store.attempts.status("default", "ada"),
        count(store, UsedNonceRow),
        store.database.read(lambda each: each.execute(sa.select(SubjectRow.last_used_at)).all()),
    )


@pytest.mark.parametrize("accepted", [True, False])
@pytest.mark.parametrize("change", ["erased", "replaced", "erased and enrolled"])
def test_a_decision_on_a_template_that_is_gone_is_taken_back(
    ada: TemplateStore, prefix: str, clock: Clock, accepted: bool, change: str
) -> None:
    decided_on, nonce = template_id(ada, "ada"), nonce_of(prefix, clock)
    if change != "replaced":
        ada.erasures.erase("default", "ada")
    if change != "erased":
        put(ada, "ada", b"another")
        attempt(ada)
    before = written(ada)
    with pytest.raises(Superseded, match="send it again") as raised:
        conclude(ada, decided_on, accepted=accepted, nonce=nonce)
    assert not raised.value.recorded
    assert written(ada) == before
    # The caller decides again, with the same nonce.
    now = template_id(ada, "ada")
    conclude(ada, now, accepted=accepted and now is not None, nonce=nonce)
    with pytest.raises(Replayed):
        begin(ada, nonce=nonce)


def test_an_accept_of_the_old_template_does_not_clear_failures_on_the_new(
    ada: TemplateStore,
) -> None:
    decided_on = template_id(ada, "ada")
    put(ada, "ada", b"another")
    for _ in range(4):
        attempt(ada)
    with pytest.raises(Superseded):
        conclude(ada, decided_on)
    assert status(ada).consecutive == 4


def test_a_rejection_of_nobody_who_is_enrolled_meanwhile_is_taken_back(
    ada: TemplateStore,
) -> None:
    with pytest.raises(Superseded):
        conclude(ada, None, accepted=False)
    assert ada.attempts.status("default", "ada") is None


def test_a_template_of_another_contract_is_as_good_as_none(ada: TemplateStore) -> None:
    conclude(ada, None, accepted=False, contract_id="d" * 64)
    assert status(ada).consecutive == 1
    with pytest.raises(Superseded):
        conclude(ada, None, accepted=False, contract_id=CONTRACT)
    with pytest.raises(Superseded):
        conclude(ada, template_id(ada, "ada"), contract_id="d" * 64)
    conclude(ada, template_id(ada, "ada"), contract_id=CONTRACT)
    assert status(ada).consecutive == 0
    found = ada.attempts.begin("default", "ada", contract_id=CONTRACT)
    assert found.template_id == template_id(ada, "ada")


def test_a_lock_and_a_replay_come_before_a_decision_that_is_gone(
    ada: TemplateStore, prefix: str, clock: Clock
) -> None:
    decided_on, nonce = template_id(ada, "ada"), nonce_of(prefix, clock)
    for _ in range(5):
        attempt(ada)
    put(ada, "ada", b"another")
    with pytest.raises(LockedOut) as locked:
        conclude(ada, decided_on, nonce=nonce)
    assert locked.value.recorded
    with pytest.raises(Replayed) as replayed:
        conclude(ada, decided_on, nonce=nonce)
    assert replayed.value.recorded


# --- deciding ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Says:
    """A decision."""

    accepted: bool
    level: str = "high"


def test_an_attempt_has_the_template_and_the_epoch(ada: TemplateStore) -> None:
    found = begin(ada)
    assert found.template is not None
    assert found.template.wire == b"wire"
    assert found.template_id == found.template.record.template_id == template_id(ada, "ada")
    assert found.rotation_epoch == ada.tenants.get("default").rotation_epoch


def test_an_attempt_on_nobody_and_on_another_contract_has_no_template(
    ada: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("templates.store.attempts.opened_template", None)  # nothing is decrypted
    for subject, contract in (("nobody", CONTRACT), ("ada", "d" * 64)):
        found = ada.attempts.begin("default", subject, contract_id=contract)
        assert found.template is None
        assert found.template_id is None
        assert found.rotation_epoch == 1


def test_an_attempt_in_an_unknown_tenant_is_refused(ada: TemplateStore) -> None:
    with pytest.raises(UnknownTenant):
        begin(ada, tenant="nowhere")


def alone(
    store: TemplateStore, decide: Callable[[Attempt], Says], *, nonce: Nonce | None = None
) -> Says:
    return store.attempts.decide_alone(
        "default", "ada", decide, contract_id=CONTRACT, nonce=nonce, by=BY
    )


def test_nobody_replaces_a_template_while_it_is_decided_on_alone(
    ada: TemplateStore, prefix: str, clock: Clock
) -> None:
    decided_on, nonce = template_id(ada, "ada"), nonce_of(prefix, clock)
    seen: list[Any] = []

    def decide(attempt: Attempt) -> Says:
        replacing.start()
        replacing.join(0.5)  # it would have done it in a few milliseconds
        seen.extend([attempt.template_id, replacing.is_alive()])
        return Says(accepted=True)

    replacing = threading.Thread(target=put, args=(ada, "ada", b"another"))
    assert alone(ada, decide, nonce=nonce) == Says(accepted=True)
    replacing.join()
    assert seen == [decided_on, True]
    assert template_id(ada, "ada") != decided_on
    with pytest.raises(Replayed):
        begin(ada, nonce=nonce)


def test_failures_are_counted_and_locks_hold_when_deciding_alone(
    ada: TemplateStore, prefix: str, clock: Clock
) -> None:
    for number in range(1, 6):
        assert not alone(ada, lambda _: Says(accepted=False)).accepted
        assert status(ada).consecutive == number
    before = written(ada)
    with pytest.raises(LockedOut):
        alone(ada, lambda _: pytest.fail("it is locked"))
    assert written(ada) == before


def test_what_deciding_alone_raises_leaves_nothing_written(
    ada: TemplateStore, prefix: str, clock: Clock
) -> None:
    before, nonce = written(ada), nonce_of(prefix, clock)

    def decide(_: Attempt) -> Says:
        raise KeyError("no face")

    with pytest.raises(KeyError):
        alone(ada, decide, nonce=nonce)
    assert written(ada) == before
    begin(ada, nonce=nonce)


# --- nonces --------------------------------------------------------------------------------


@pytest.fixture
def prefix(ada: TemplateStore) -> str:
    return ada.api_keys.create("default", ["verify", "embeddings"]).key.prefix


def nonce_of(prefix: str, clock: Clock, value: str = "n" * 16) -> Nonce:
    return Nonce(prefix, value, clock.time + timedelta(minutes=2))


def test_a_nonce_serves_once(ada: TemplateStore, prefix: str, clock: Clock) -> None:
    nonce = nonce_of(prefix, clock)
    begin(ada, nonce=nonce)
    assert attempt(ada, accepted=True, nonce=nonce) == "accept"
    with pytest.raises(Replayed, match="seen before"):
        begin(ada, nonce=nonce)
    assert attempt(ada, accepted=True, nonce=nonce) == "replayed"
    assert attempt(ada, "nobody", known=False, nonce=nonce) == "replayed"
    assert ada.attempts.status("default", "nobody") is None  # a replay is no failure
    assert attempt(ada, accepted=True, nonce=nonce_of(prefix, clock, "m" * 16)) == "accept"
    other = ada.api_keys.create("default", ["verify"]).key.prefix
    assert attempt(ada, accepted=True, nonce=nonce_of(other, clock)) == "accept"


def test_a_refused_probe_is_used_up_too(ada: TemplateStore, prefix: str, clock: Clock) -> None:
    for _ in range(5):
        attempt(ada)
    nonce = nonce_of(prefix, clock)
    assert attempt(ada, accepted=True, nonce=nonce) == "locked 30"
    clock.pass_by(seconds=31)
    assert attempt(ada, accepted=True, nonce=nonce) == "replayed"


def test_the_value_of_a_nonce_is_not_kept(ada: TemplateStore, prefix: str, clock: Clock) -> None:
    nonce = nonce_of(prefix, clock)
    assert nonce.value not in repr(nonce)
    attempt(ada, nonce=nonce)
    rows = ada.database.read(lambda each: each.execute(sa.select(UsedNonceRow.__table__)).all())
    assert len(rows) == 1
    assert nonce.value not in repr(rows)


def test_a_nonce_of_an_unknown_key_is_refused(ada: TemplateStore, clock: Clock) -> None:
    with pytest.raises(StoreError, match="no API key"):
        attempt(ada, nonce=nonce_of("0" * 12, clock))
    assert [each.action for each in ada.audit_log.lines()] == ["enroll"]


def test_nonces_expire_in_small_transactions(
    ada: TemplateStore, prefix: str, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("templates.store.attempts.BATCH", 2)
    for number in range(5):
        attempt(ada, accepted=True, nonce=nonce_of(prefix, clock, f"nonce-{number:016}"))
    clock.pass_by(minutes=6)
    attempt(ada, accepted=True, nonce=nonce_of(prefix, clock))
    assert ada.attempts.expire() == 0  # past their time, within the grace
    clock.pass_by(minutes=1)
    assert ada.attempts.expire() == 5
    assert count(ada, UsedNonceRow) == 1
    assert attempt(ada, accepted=True, nonce=nonce_of(prefix, clock)) == "replayed"


# --- the audit line ------------------------------------------------------------------------


def test_every_conclusion_has_its_line(ada: TemplateStore, prefix: str, clock: Clock) -> None:
    nonce = nonce_of(prefix, clock)
    attempt(ada, accepted=True, nonce=nonce)
    attempt(ada, accepted=True, nonce=nonce)
    for _ in range(5):
        attempt(ada)
    attempt(ada, accepted=True)
    attempt(ada, "nobody", known=False)
    lines = [each for each in ada.audit_log.lines() if each.action == "verify"]
    assert [each.outcome for each in lines] == [
        *("accept", "replayed", "reject", "reject", "reject", "reject", "reject"),
        *("locked_out", "reject"),
    ]
    assert {(each.actor, each.request_id, each.detail) for each in lines} == {
        (BY.actor, BY.request_id, "high")
    }
    assert lines[0].pseudonym == ada.signer.pseudonym("default", "ada")
    assert lines[-1].pseudonym == ada.signer.pseudonym("default", "nobody")
    assert ada.audit_log.verify().intact


# --- many at once --------------------------------------------------------------------------


def in_threads(store: TemplateStore, attempts: list[dict[str, object]]) -> Counter[str]:
    answers: list[str] = []
    errors: list[BaseException] = []
    start = threading.Barrier(len(attempts))

    def one(arguments: dict[str, object]) -> None:
        start.wait()
        try:
            answers.append(attempt(store, **arguments))  # type: ignore[arg-type]
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=one, args=(each,)) for each in attempts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    return Counter(answers)


@pytest.mark.parametrize("known", [True, False])
def test_at_most_five_rejections_are_let_out_however_many_come_at_once(
    ada: TemplateStore, known: bool
) -> None:
    subject = "ada" if known else "nobody"
    answers = in_threads(ada, [{"subject": subject, "known": known}] * 32)
    assert answers == {"reject": 5, "locked 30": 27}
    assert status(ada, subject).consecutive == status(ada, subject).total == 5
    outcomes = Counter(each.outcome for each in ada.audit_log.lines() if each.action == "verify")
    assert outcomes == {"reject": 5, "locked_out": 27}
    assert ada.audit_log.verify().intact


def test_one_accept_among_many_failures_is_equal_to_some_order(ada: TemplateStore) -> None:
    answers = in_threads(ada, [*[{}] * 16, {"accepted": True}, *[{}] * 16])
    outcomes = [each.outcome for each in ada.audit_log.lines() if each.action == "verify"]
    assert Counter(outcomes)["reject"] == answers["reject"]
    assert Counter(outcomes)["locked_out"] == answers["locked 30"]
    before = outcomes.index("accept") if "accept" in outcomes else None
    if before is None:
        assert answers == {"reject": 5, "locked 30": 28}
    else:
        assert before < 5  # else the subject was locked, and the accept not let out
        assert outcomes[before + 1 :].count("reject") == 5
        assert answers == {"accept": 1, "reject": before + 5, "locked 30": 27 - before}


def test_of_many_with_one_nonce_one_is_decided(
    ada: TemplateStore, prefix: str, clock: Clock
) -> None:
    nonce = nonce_of(prefix, clock)
    answers = in_threads(ada, [{"accepted": True, "nonce": nonce}] * 16)
    assert answers == {"accept": 1, "replayed": 15}


def test_processes_lose_no_failure(
    ada: TemplateStore, database_url: str, keyring: MasterKeyring
) -> None:
    free = TemplateStore(database_url, keyring, lockout=LockoutPolicy(after=0))

    def work(output: TextIO) -> None:
        for _ in range(40):
            print(attempt(free, "nobody", known=False), file=output)

    children = [fork(work) for _ in range(3)]
    for child, output in children:
        with output:
            assert output.read().split() == ["reject"] * 40
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    found = status(free, "nobody")
    assert found.consecutive == found.total == 120
    free.close()


def test_processes_let_out_five_rejections_together(ada: TemplateStore) -> None:
    def work(output: TextIO) -> None:
        for _ in range(6):
            print(attempt(ada).split()[0], file=output)

    children = [fork(work) for _ in range(4)]
    answers: Counter[str] = Counter()
    for child, output in children:
        with output:
            answers.update(output.read().split())
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert answers == {"reject": 5, "locked": 19}


def test_concluding_beside_enrolling_and_erasing_never_deadlocks(ada: TemplateStore) -> None:
    """With a count left for whom nobody holds, or none: never one that no expiry removes."""
    names = ["ada", "eve"]
    errors: list[BaseException] = []

    def use(seed: int) -> None:
        try:
            for number in range(12):
                name = names[(seed + number) % 2]
                match (seed + number) % 4:
                    case 0:
                        put(ada, name, b"wire")
                    case 1:
                        ada.erasures.erase("default", name)
                    case _:
                        attempt(ada, name)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=use, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert ada.audit_log.verify().intact
    for known, pseudonym in rows(ada):
        enrolled = {
            ada.signer.pseudonym("default", each)
            for each in names
            if ada.subjects.get("default", each)
        }
        assert known == (pseudonym in enrolled)


def rows(store: TemplateStore) -> Iterator[tuple[bool, str]]:
    query = sa.select(FailedAttemptsRow.known, FailedAttemptsRow.pseudonym)
    yield from store.database.read(lambda each: each.execute(query).all())
