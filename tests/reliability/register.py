"""What a subject is to its clients: enrolled as one person or not, and with a last receipt.

Enrolling, erasing, verifying and describing one subject are calls on such a register. A
verification of person Y is accepted if and only if Y is who is enrolled (the lockout is off).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tests.reliability.linearizability import Call, serial_order
from tests.reliability.operations import Operation


@dataclass(frozen=True)
class Enrolled:
    """An enrollment; its template id is not known where nobody was told of it."""

    person: int
    template_id: str | None
    request_id: str


@dataclass(frozen=True)
class SubjectState:
    """State of one subject.

    Attributes
    ----------
    enrolled
        Its enrollment, or None.
    receipt
        Receipt id of its last erasure; None without one, the request's id in angle brackets where
        nobody was told.
    """

    enrolled: Enrolled | None = None
    receipt: str | None = None


def step_for(
    operations: Sequence[Operation],
) -> Callable[[SubjectState, Operation], SubjectState | None]:
    """Return the register's step, given all operations on the subject."""
    told = {each.template_id for each in operations if each.kind == "enroll" and each.answered_well}

    def step(state: SubjectState, each: Operation) -> SubjectState | None:
        match each.kind:
            case "enroll":
                return _enroll(state, each)
            case "erase":
                return _erase(state, each)
            case "verify":
                enrolled = state.enrolled is not None and state.enrolled.person == each.person
                return state if enrolled == each.accepted else None
            case "describe":
                return state if _describes(state.enrolled, each.template_id, told) else None
        raise AssertionError(each.kind)

    return step


def _enroll(state: SubjectState, each: Operation) -> SubjectState | None:
    if each.answered_well and each.replaced != (state.enrolled is not None):
        return None
    assert each.person is not None
    return replace(state, enrolled=Enrolled(each.person, each.template_id, each.request_id))


def _erase(state: SubjectState, each: Operation) -> SubjectState | None:
    repeats = state.enrolled is None and state.receipt is not None
    if not each.answered_well:
        return state if repeats else SubjectState(None, f"<{each.request_id}>")
    if repeats:
        known = state.receipt is not None and not state.receipt.startswith("<")
        return state if not known or state.receipt == each.receipt_id else None
    if each.receipt_id == state.receipt or each.held != (state.enrolled is not None):
        return None
    return SubjectState(None, each.receipt_id)


def _describes(enrolled: Enrolled | None, seen: str | None, told: set[str | None]) -> bool:
    if enrolled is None or seen is None:
        return enrolled is None and seen is None
    if enrolled.template_id is None:
        return seen not in told
    return seen == enrolled.template_id


def call_of(each: Operation, *, effective: bool | None = None) -> Call:
    """Give an operation its place in a history.

    Parameters
    ----------
    effective
        Whether an operation without a good answer took effect, where that is known.
    """
    return Call(
        each.started,
        each.over,
        each,
        answered=each.answered_well or bool(effective),
        reads=each.kind in ("verify", "describe"),
    )


def explain(calls: Sequence[Call]) -> list[Call] | None:
    """Find a serial order of the calls on one subject; None if there is none."""
    step: Callable[[SubjectState, Any], SubjectState | None] = step_for(
        [call.content for call in calls]
    )
    return serial_order(calls, step, SubjectState())
