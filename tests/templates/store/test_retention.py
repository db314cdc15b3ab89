import threading
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pytest

from templates.store import Receipt, Retention, TemplateStore, verify_audit_log, verify_receipt
from templates.store.erasure import Erasures
from tests.templates.store.conftest import CONTRACT, Clock, put
from tests.templates.store.test_attempts import attempt

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
    assert five.erasures.count_due(keep) == 5 - len(kept)
    assert five.erasures.erase_expired(keep, batch=2) == 5 - len(kept)
    assert names(five) == kept
    assert five.erasures.count_due(keep) == 0
    assert five.erasures.erase_expired(keep) == 0


def test_it_is_the_ordinary_erasure(store: TemplateStore, clock: Clock) -> None:
    put(store, "ada", b"wire")
    put(store, "ada", b"wire", tenant="other")
    clock.pass_by(days=10)
    assert store.erasures.erase_expired(Retention(5 * DAY)) == 2
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
    assert verify_audit_log(store).intact


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
    assert store.erasures.erase_expired(Retention(None, 5 * DAY)) == 1
    survives = change in ("enrolled again", "used", "made anew")
    assert names(store) == (["ada"] if survives else [])
    by_retention = [line for line in store.audit_log.lines() if line.actor == "retention"]
    assert [line.pseudonym for line in by_retention] == [store.signer.pseudonym("default", "eve")]
