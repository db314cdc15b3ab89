"""Decisions: what they read, how failures are counted, locks, one-use tokens, and races."""

import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TextIO

import pytest
import sqlalchemy as sa

from templates.errors import StoreBusy
from templates.keys.sealing import MasterKeyring
from templates.store import (
    Attempt,
    AttemptsStatus,
    By,
    LockedOut,
    LockoutPolicy,
    Replayed,
    RetiredRotation,
    TemplateStore,
    UnknownTenant,
    verify_audit_log,
)
from templates.store.attempts import DECISION_QUERY, TRIES
from templates.store.audit_log import token_digest
from templates.store.schema import SubjectRow
from tests.databases import execute
from tests.templates.store.conftest import CONTRACT, Clock, put, template_id
from tests.templates.store.test_concurrency import in_processes

BY = By("key:00112233aabb", "request-12345678")
TOKEN = token_digest("00112233aabb", "random id")

# The children do nothing but use the store; threads that other tests left behind are not theirs.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")


@dataclass(frozen=True)
class Says:
    """A decision."""

    accepted: bool
    level: str = "high"


def decide(
    store: TemplateStore,
    compare: Any,
    *,
    subject: str = "ada",
    tenant: str = "default",
    contract_id: str = CONTRACT,
    token: str | None = None,
) -> Says:
    return store.attempts.decide(  # type: ignore[no-any-return]
        tenant, subject, compare, contract_id=contract_id, token=token, by=BY
    )


def attempt(store: TemplateStore, subject: str = "ada", **options: Any) -> str:
    """What the client of one verification is told."""
    accepted = options.pop("accepted", False)
    try:
        decide(store, lambda _: Says(accepted), subject=subject, **options)
    except LockedOut as error:
        return "disabled" if error.retry_after_s is None else f"locked {error.retry_after_s:g}"
    except Replayed:
        return "replayed"
    return "accept" if accepted else "reject"


def seen(store: TemplateStore, **options: Any) -> Attempt:
    """What a decision is made by."""
    attempts: list[Attempt] = []

    def compare(each: Attempt) -> Says:
        attempts.append(each)
        return Says(accepted=False)

    decide(store, compare, **options)
    return attempts[-1]


def status(store: TemplateStore, subject: str = "ada") -> AttemptsStatus:
    counted = store.attempts.status("default", subject)
    assert counted is not None
    return counted


def outcomes(store: TemplateStore) -> list[str]:
    return [line.outcome for line in store.audit_log.lines() if line.action == "verify"]


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
        counted = status(ada)
        assert counted.consecutive == number
        assert counted.last_failed_at == clock.time
        if number < 5:
            assert counted.locked_until is None
            continue
        seconds = expected.get(number, 3600)
        assert counted.locked_until == clock.time + timedelta(seconds=seconds)
        if number == 50:
            break
        assert attempt(ada, accepted=True) == f"locked {seconds}"
        clock.pass_by(seconds=seconds - 0.25)
        assert attempt(ada) == "locked 0.25"
        assert status(ada).consecutive == number  # nothing is counted meanwhile
        clock.pass_by(seconds=0.25)
    assert status(ada).disabled_at == clock.time
    clock.pass_by(days=1000)
    assert attempt(ada, accepted=True) == "disabled"


def test_a_lock_is_told_before_anything_is_compared_and_again_at_the_record(
    ada: TemplateStore, clock: Clock
) -> None:
    for _ in range(4):
        attempt(ada)

    def fails_once_more_meanwhile(_: Attempt) -> Says:
        attempt(ada)
        return Says(accepted=True)

    with pytest.raises(LockedOut, match="try again in 30 s") as at_the_record:
        decide(ada, fails_once_more_meanwhile, token=TOKEN)
    assert at_the_record.value.recorded
    assert outcomes(ada)[-1] == "locked_out"
    clock.pass_by(seconds=10)
    with pytest.raises(LockedOut, match="try again in 20 s") as before:
        decide(ada, lambda _: pytest.fail("it is locked"))
    assert not before.value.recorded
    clock.pass_by(seconds=20)
    assert attempt(ada, accepted=True, token=TOKEN) == "replayed"  # the refusal used it up


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
    def last_used() -> object:
        return execute(ada.database, sa.select(SubjectRow.last_used_at))[0][0]

    assert attempt(ada, accepted=True) == "accept"
    assert ada.attempts.status("default", "ada") is None  # nothing ever failed
    clock.pass_by(hours=1)
    for _ in range(4):
        assert attempt(ada) == "reject"
    assert last_used() == clock.time - timedelta(hours=1)
    assert attempt(ada, accepted=True) == "accept"
    assert last_used() == clock.time
    assert status(ada).consecutive == 0
    for _ in range(4):
        assert attempt(ada) == "reject"


def test_a_long_row_of_failures_does_not_overflow(clock: Clock) -> None:
    locked = LockoutPolicy(disable_at=10**9).status(10**8, clock.time)
    assert locked.locked_until == clock.time + timedelta(hours=1)


def test_without_a_lockout_nothing_locks(clock: Clock) -> None:
    never, locked = LockoutPolicy(after=0), LockoutPolicy().status(50, clock.time)
    assert never.status(50, clock.time) == AttemptsStatus(50, clock.time, None, None)
    assert never.refusal(locked, clock.time) is None  # which an earlier setting left


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
    assert status(ada).consecutive == 0
    assert attempt(ada, accepted=True) == "accept"
    resets = [line for line in ada.audit_log.lines() if line.action == "lockout-reset"]
    assert [line.outcome for line in resets] == ["nothing_held", "reset", "nothing_held"]
    assert {line.actor for line in resets} == {"operator:root"}
    assert {line.pseudonym for line in resets} == {ada.signer.pseudonym("default", "ada")}


def test_an_erasure_takes_the_count_along_and_a_replacement_keeps_it(ada: TemplateStore) -> None:
    for _ in range(5):
        attempt(ada)
    put(ada, "ada", b"again")
    assert attempt(ada, accepted=True) == "locked 30"
    erased = ada.erasures.erase("default", "ada").receipt.claims["erased"]
    assert {"item": "failed_attempts", "count": 1} in erased
    assert ada.attempts.status("default", "ada") is None
    put(ada, "ada", b"wire")
    assert attempt(ada, accepted=True) == "accept"


def test_counts_expire_ninety_days_after_the_last_failure(ada: TemplateStore, clock: Clock) -> None:
    for name in ("ada", "nobody"):
        attempt(ada, name)
    for _ in range(50):
        attempt(ada, "disabled")
        clock.pass_by(hours=1)
    clock.pass_by(days=87)
    assert ada.attempts.expire() == 0
    attempt(ada, "nobody")
    clock.pass_by(days=2)
    assert ada.attempts.expire() == 1
    assert ada.attempts.status("default", "ada") is None
    for name in ("nobody", "disabled"):
        assert ada.attempts.status("default", name) is not None, name
    assert ada.purge()


# --- what a decision is made by ------------------------------------------------------------


def test_a_template_of_another_contract_is_as_good_as_none(
    ada: TemplateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = seen(ada)
    assert found.template is not None
    assert found.template.wire == b"wire"
    assert found.template.template_id == template_id(ada, "ada")
    monkeypatch.setattr("templates.store.attempts.opened_template", None)  # nothing is decrypted
    for subject, contract, failures in (("nobody", CONTRACT, 1), ("ada", "d" * 64, 2)):
        found = seen(ada, subject=subject, contract_id=contract)
        assert (found.template, found.rotation_epoch) == (None, 1)
        assert status(ada, subject).consecutive == failures


def test_an_attempt_in_an_unknown_tenant_and_an_accept_of_nobody_are_refused(
    ada: TemplateStore,
) -> None:
    with pytest.raises(UnknownTenant):
        attempt(ada, tenant="nowhere")
    with pytest.raises(ValueError, match="not enrolled"):
        attempt(ada, "stranger", accepted=True)


def test_a_subject_without_a_template_costs_as_many_bytes(store: TemplateStore) -> None:
    """Else the time tells who is enrolled. Several subjects do not all cost the same bytes."""

    def read(subject: str) -> list[bytes]:
        pseudonym = store.signer.pseudonym("default", subject)
        parameters = {
            "tenant": "default",
            "subject_id": subject,
            "pseudonym": pseudonym,
            "place": pseudonym[:32],
            "contract_id": CONTRACT,
            "token": None,
        }
        (row,) = execute(store.database, DECISION_QUERY, **parameters)
        own = None if row.SubjectRow is None else row.SubjectRow.ciphertext
        return [blob for blob in (own, row.stand_in) if blob is not None]

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


# --- decisions on what is no more ----------------------------------------------------------


@pytest.mark.parametrize("accepted", [True, False])
@pytest.mark.parametrize("change", ["erased", "replaced", "erased and enrolled"])
def test_a_decision_on_a_template_that_is_gone_is_made_again(
    ada: TemplateStore, accepted: bool, change: str
) -> None:
    decided_on: list[str | None] = []

    def compare(each: Attempt) -> Says:
        template = each.template
        decided_on.append(None if template is None else template.template_id)
        if len(decided_on) == 1:
            if change != "replaced":
                ada.erasures.erase("default", "ada")
            if change != "erased":
                put(ada, "ada", b"another")
        return Says(accepted and template is not None)

    first = template_id(ada, "ada")
    decide(ada, compare, token=TOKEN)
    assert decided_on == [first, template_id(ada, "ada")]
    assert outcomes(ada) == ["accept" if accepted and change != "erased" else "reject"]
    assert attempt(ada, token=TOKEN) == "replayed"


def test_a_template_that_changes_again_and_again_is_decided_while_no_other_write_runs(
    ada: TemplateStore, keyring: MasterKeyring
) -> None:
    """Another process enrolls at every comparison: the last one keeps it waiting."""
    decided_on: list[str | None] = []
    url = ada.database.url.render_as_string(hide_password=False)
    others = TemplateStore(url, keyring, timeout=0.1)

    def compare(each: Attempt) -> Says:
        decided_on.append(None if each.template is None else each.template.template_id)
        if len(decided_on) <= TRIES:
            put(others, "ada", b"another")
        else:
            with pytest.raises(StoreBusy):
                put(others, "ada", b"another")
        return Says(accepted=True)

    assert decide(ada, compare, token=TOKEN).accepted
    others.close()
    assert len(set(decided_on)) == TRIES + 1
    assert decided_on[-1] == template_id(ada, "ada")
    assert outcomes(ada) == ["accept"]
    assert attempt(ada, token=TOKEN) == "replayed"


def test_a_rotation_that_was_retired_meanwhile_is_looked_at_again(ada: TemplateStore) -> None:
    calls: list[Attempt] = []

    def compare(each: Attempt) -> Says:
        calls.append(each)
        if len(calls) == 1:
            raise RetiredRotation("no key of this epoch")
        return Says(accepted=True)

    assert decide(ada, compare).accepted
    assert len(calls) == 2


def test_what_a_comparison_raises_leaves_nothing_written(ada: TemplateStore) -> None:
    head = ada.audit_log.head()

    def compare(_: Attempt) -> Says:
        raise KeyError("no face")

    with pytest.raises(KeyError):
        decide(ada, compare, token=TOKEN)
    assert ada.audit_log.head() == head
    assert ada.attempts.status("default", "ada") is None
    ada.audit_log.require_unused(TOKEN)


# --- one-use tokens ------------------------------------------------------------------------


def test_a_token_serves_once(ada: TemplateStore) -> None:
    assert ada.audit_log.use_of(TOKEN) is None
    ada.audit_log.require_unused(TOKEN)
    assert attempt(ada, accepted=True, token=TOKEN) == "accept"
    with pytest.raises(Replayed, match="used before"):
        ada.audit_log.require_unused(TOKEN)
    assert attempt(ada, accepted=True, token=TOKEN) == "replayed"
    assert attempt(ada, "nobody", token=TOKEN) == "replayed"
    assert ada.attempts.status("default", "nobody") is None  # a replay is no failure
    used = ada.audit_log.use_of(TOKEN)
    assert used is not None
    assert (used.outcome, used.detail) == ("accept", "high")
    assert attempt(ada, token=token_digest("00112233aabb", "another id")) == "reject"
    assert attempt(ada, token=token_digest("ffffffffffff", "random id")) == "reject"


def test_a_token_that_is_used_meanwhile_is_replayed_with_a_line(ada: TemplateStore) -> None:
    def compare(_: Attempt) -> Says:
        assert attempt(ada, token=TOKEN) == "reject"
        return Says(accepted=True)

    with pytest.raises(Replayed) as raised:
        decide(ada, compare, token=TOKEN)
    assert raised.value.recorded
    assert outcomes(ada) == ["reject", "replayed"]


# --- many at once --------------------------------------------------------------------------


def in_threads(store: TemplateStore, attempts: list[dict[str, Any]]) -> Counter[str]:
    """Answers of attempts that are all compared before the first of them is recorded."""
    compared = threading.Barrier(len(attempts))

    def one(arguments: dict[str, Any]) -> str:
        accepted = arguments.get("accepted", False)

        def compare(_: Attempt) -> Says:
            compared.wait()
            return Says(accepted)

        options = {name: arguments[name] for name in arguments if name != "accepted"}
        try:
            decide(store, compare, **options)
        except (LockedOut, Replayed) as error:
            return "locked" if isinstance(error, LockedOut) else "replayed"
        return "accept" if accepted else "reject"

    with ThreadPoolExecutor(len(attempts)) as threads:
        return Counter(threads.map(one, attempts))


@pytest.mark.parametrize("subject", ["ada", "nobody"])
def test_at_most_five_rejections_are_let_out_however_many_come_at_once(
    ada: TemplateStore, subject: str
) -> None:
    assert in_threads(ada, [{"subject": subject}] * 14) == {"reject": 5, "locked": 9}
    assert status(ada, subject).consecutive == 5
    assert Counter(outcomes(ada)) == {"reject": 5, "locked_out": 9}
    assert verify_audit_log(ada).intact


def test_of_many_with_one_token_one_is_decided(ada: TemplateStore) -> None:
    answers = in_threads(ada, [{"accepted": True, "token": TOKEN}] * 14)
    assert answers == {"accept": 1, "replayed": 13}


def test_processes_count_together(ada: TemplateStore) -> None:
    def work(output: TextIO) -> None:
        for _ in range(6):
            print(attempt(ada).split()[0], file=output)

    answers = Counter(" ".join(in_processes(work, ada, 4)).split())
    assert answers == {"reject": 5, "locked": 19}
