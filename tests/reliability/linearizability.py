"""Is there a serial order of concurrent calls that explains every answer?

The search is that of Wing and Gong with the memory of Lowe: a call may come next if no call that
is still to come ended before it began, and a set of calls that led to a state once need not be
tried again. A call without an answer may have taken effect at one moment up to its end, or never.

References
----------
J. M. Wing, C. Gong, Testing and Verifying Concurrent Objects, J. Parallel Distrib. Comput. 17
(1993). G. Lowe, Testing for Linearizability, Concurrency Computat. Pract. Exper. 29 (2017).
"""

import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

State = TypeVar("State", bound=Hashable)

MOST_STATES = 2_000_000


class SearchTooLong(Exception):
    """No order was found among so many partial ones that the search was given up: no verdict."""


@dataclass(frozen=True)
class Call:
    """One call: when it was sent, when it was over, and what it asked and was answered.

    Attributes
    ----------
    start, end
        On one clock. The end of a call without an answer is the moment after which it cannot take
        effect any more; infinity if there is none.
    content
        What the model of the object reads.
    answered
        Whether it took effect for sure; otherwise it may have.
    reads
        Whether it never changes the state.
    """

    start: float
    end: float
    content: Any
    answered: bool = True
    reads: bool = False

    def __post_init__(self) -> None:
        if not self.start <= self.end:
            raise ValueError("a call ends after it starts")


class _Search(Generic[State]):
    """The state of one search; calls are named by their place in the order of their starts."""

    def __init__(
        self, calls: Sequence[Call], step: Callable[[State, Any], State | None], initial: State
    ) -> None:
        self._calls = calls
        self._step = step
        self._initial = initial
        self._answered = sum(1 << i for i, call in enumerate(calls) if call.answered)

    def order(self) -> list[int] | None:
        """Return an order of the calls that took effect, or None."""
        seen: set[tuple[int, State]] = set()
        # Depth first, with a stack of our own: histories are longer than Python's.
        path: list[int] = []
        stack = [iter([(0, self._initial, -1)])]
        while stack:
            following = next(stack[-1], None)
            if following is None:
                stack.pop()
                if path:
                    path.pop()
                continue
            done, state, taken = following
            if (done, state) in seen:
                continue
            seen.add((done, state))
            if len(seen) > MOST_STATES:
                raise SearchTooLong(f"{len(self._calls)} calls overlap too much")
            path.append(taken)
            if done & self._answered == self._answered:
                return path[1:]
            stack.append(self._following(done, state))
        return None

    def _following(self, done: int, state: State) -> Iterator[tuple[int, State, int]]:
        ready = self._ready(done)
        for i in ready:
            if self._calls[i].reads and self._step(state, self._calls[i].content) is not None:
                closed = self._closed(done | 1 << i, self._calls[i].start)
                if closed == done | 1 << i:
                    # Whatever order explains the rest, it also does with this read put first.
                    yield closed, state, i
                    return
        # Calls without an answer last: most of them had no effect.
        for i in sorted(ready, key=lambda i: (not self._calls[i].answered, self._calls[i].end)):
            after = self._step(state, self._calls[i].content)
            if after is not None:
                yield self._closed(done | 1 << i, self._calls[i].start), after, i

    def _ready(self, done: int) -> list[int]:
        """Calls that may come next: none that is still to come ended before they began."""
        candidates: list[int] = []
        earliest_end = math.inf
        i = (~done & (done + 1)).bit_length() - 1  # the first that is not done
        while i < len(self._calls) and self._calls[i].start <= earliest_end:
            call = self._calls[i]
            if not done >> i & 1:
                candidates.append(i)
                if call.answered:
                    earliest_end = min(earliest_end, call.end)
            i += 1
        return [i for i in candidates if self._calls[i].start <= earliest_end]

    def _closed(self, done: int, now: float) -> int:
        """Give up the calls without an answer that ended before `now`."""
        i = (~done & (done + 1)).bit_length() - 1
        while i < len(self._calls) and self._calls[i].start <= now:
            if not done >> i & 1 and not self._calls[i].answered and self._calls[i].end < now:
                done |= 1 << i
            i += 1
        return done


def serial_order(
    calls: Sequence[Call], step: Callable[[State, Any], State | None], initial: State
) -> list[Call] | None:
    """Find an order of the calls in which each has one moment between its start and its end.

    Parameters
    ----------
    calls
        In any order.
    step
        The object: its state after a call; None where the call cannot be answered as it was.
    initial
        State before all calls.

    Returns
    -------
    list of Call or None
        The calls that took effect, in that order; None if there is no such order.

    Raises
    ------
    SearchTooLong
        Where many calls overlap, and many of them had no answer.
    """
    ordered = sorted(calls, key=lambda call: (call.start, call.end))
    order = _Search(ordered, step, initial).order()
    return None if order is None else [ordered[i] for i in order]
