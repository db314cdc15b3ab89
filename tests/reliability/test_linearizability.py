"""The checker itself: against all orders tried one by one, and on histories that are wrong."""

import itertools
import math
import random

import pytest

from tests.reliability.linearizability import Call, SearchTooLong, serial_order

Content = tuple[str, int | None]
State = tuple[int | None]

EMPTY: State = (None,)


def step(state: State, content: Content) -> State | None:
    """A register of one number."""
    kind, value = content
    if kind == "write":
        return (value,)
    return state if state == (value,) else None


def write(start: float, end: float, value: int | None, *, answered: bool = True) -> Call:
    return Call(start, end, ("write", value), answered=answered)


def read(start: float, end: float, value: int | None) -> Call:
    return Call(start, end, ("read", value), reads=True)


def explained(*calls: Call) -> bool:
    return serial_order(calls, step, EMPTY) is not None


def explained_by_trying(calls: list[Call]) -> bool:
    """Every subset of the calls without an answer, in every order."""
    sure = [call for call in calls if call.answered]
    unsure = [call for call in calls if not call.answered]
    for count in range(len(unsure) + 1):
        for chosen in itertools.combinations(unsure, count):
            for order in itertools.permutations([*sure, *chosen]):
                if _fits(order):
                    return True
    return False


def _fits(order: tuple[Call, ...]) -> bool:
    now, state = -math.inf, EMPTY
    for call in order:
        now = max(now, call.start)
        after = step(state, call.content)
        if now > call.end or after is None:
            return False
        state = after
    return True


def test_one_after_the_other() -> None:
    assert explained(write(0, 1, 7), read(2, 3, 7), write(4, 5, 8), read(6, 7, 8))


def test_a_read_beside_a_write_sees_either() -> None:
    for value in (1, 2):
        assert explained(write(0, 1, 1), write(2, 5, 2), read(3, 4, value))


def test_a_stale_read_is_found() -> None:
    assert not explained(write(0, 1, 1), write(2, 3, 2), read(4, 5, 1))


def test_a_lost_write_is_found() -> None:
    assert not explained(write(0, 1, 1), read(2, 3, None))


def test_two_reads_that_see_two_writes_in_two_orders_are_found() -> None:
    writes = (write(0, 9, 1), write(0, 9, 2))
    assert explained(*writes, read(1, 2, 1), read(3, 4, 2))
    assert not explained(*writes, read(1, 2, 1), read(3, 4, 2), read(5, 6, 1), read(7, 8, 2))


def test_a_value_that_was_never_written_is_found() -> None:
    assert not explained(write(0, 1, 1), read(0, 9, 3))


def test_an_unanswered_write_may_show_or_not() -> None:
    lost = write(0, 10, 5, answered=False)
    assert explained(lost, read(1, 2, None))
    assert explained(lost, read(1, 2, 5), read(3, 4, 5))
    assert explained(lost, read(1, 2, None), read(3, 4, 5))


def test_an_unanswered_write_shows_once_and_not_after_its_end() -> None:
    lost = write(0, 10, 5, answered=False)
    assert not explained(lost, read(1, 2, 5), read(3, 4, None))
    assert not explained(lost, read(11, 12, None), read(13, 14, 5))
    forever = write(0, math.inf, 5, answered=False)
    assert explained(forever, read(11, 12, None), read(13, 14, 5))


def test_the_order_that_is_returned_is_one() -> None:
    calls = [write(0, 9, 1), write(0, 9, 2), read(1, 2, 1), read(3, 4, 2)]
    order = serial_order(calls, step, EMPTY)
    assert order is not None
    assert _fits(tuple(order))
    assert sorted(map(id, order)) == sorted(map(id, calls))


def test_a_search_that_is_given_up_is_no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.reliability.linearizability.MOST_STATES", 100)
    lost = [write(0, math.inf, value, answered=False) for value in range(12)]
    with pytest.raises(SearchTooLong):
        explained(*lost, read(1, 2, 77))


def test_a_call_cannot_end_before_it_starts() -> None:
    with pytest.raises(ValueError, match="ends after"):
        write(2, 1, 0)


@pytest.mark.parametrize("seed", range(4))
def test_it_agrees_with_trying_all_orders(seed: int) -> None:
    """Short histories, true and false ones in about equal numbers."""
    draw = random.Random(seed)
    verdicts: list[bool] = []
    for _ in range(400):
        calls: list[Call] = []
        for _ in range(draw.randint(2, 6)):
            start = draw.randint(0, 8)
            end = start + draw.randint(0, 5)
            kind = draw.choice("rrww?")
            if kind == "r":
                calls.append(read(start, end, draw.choice([None, 1, 2])))
            else:
                calls.append(write(start, end, draw.choice([None, 1, 2]), answered=kind == "w"))
        verdict = explained(*calls)
        assert verdict == explained_by_trying(calls), calls
        verdicts.append(verdict)
    assert 0.2 < sum(verdicts) / len(verdicts) < 0.9


def test_long_histories_are_checked_in_time() -> None:
    """8 clients, 2,000 calls, read from a register that really is one; then one answer altered."""
    draw = random.Random(1)
    calls: list[Call] = []
    free_at = [0.0] * 8
    state: int | None = None
    now = 0.0
    for number in range(2000):
        client = min(range(8), key=lambda each: free_at[each])
        start = max(free_at[client], now - 4)
        now = max(now, start) + draw.random()
        free_at[client] = end = now + draw.uniform(0, 8)
        if draw.random() < 0.5:
            state = number
            answered = draw.random() < 0.95
            calls.append(write(start, end + (0 if answered else 9), state, answered=answered))
        else:
            calls.append(read(start, end, state))
    assert sum(1 for call in calls[:-1] if call.end > calls[-1].start) >= 4
    assert explained(*calls)
    last = max(i for i, call in enumerate(calls) if call.reads)
    altered = Call(calls[last].start, calls[last].end, ("read", 2), reads=True)
    assert not explained(*calls[:last], altered, *calls[last + 1 :])
