"""Clients in threads that enroll, erase, verify and describe a few subjects until they are told."""

import math
import random
import threading
from collections.abc import Callable
from types import TracebackType

from tests.patience import PATIENCE_S
from tests.reliability.operations import LOST, NOT_SENT, Clients, Operation

PEOPLE_EACH = 3
ERASED = 0.35
DESCRIBED = 0.25
PAUSE_S = 0.02


def make_subjects(count: int) -> dict[str, list[int]]:
    """Name subjects, each with the people that it is enrolled as, one or the other."""
    return {
        f"subject-{i}": [1 + PEOPLE_EACH * i + k for k in range(PEOPLE_EACH)] for i in range(count)
    }


def people_of(subjects: dict[str, list[int]]) -> list[int]:
    """Everybody who is enrolled as one of the subjects."""
    return [person for people in subjects.values() for person in people]


class Load:
    """Writers and readers on all subjects, from the start of the block to its end.

    A client that gets no answer, or 503, waits a moment and goes on with something else.
    """

    def __init__(
        self,
        clients: Clients,
        subjects: dict[str, list[int]],
        *,
        writers: int,
        readers: int,
        seed: int,
    ) -> None:
        self._clients = clients
        self._subjects = subjects
        self._stopping = threading.Event()
        self._wrote = threading.Condition()
        self._failures: list[BaseException] = []
        self.acknowledged = 0
        self._most = math.inf
        self._threads = [
            threading.Thread(target=self._run, args=(work, random.Random(f"{seed} {i}")))
            for i, work in enumerate([self._write] * writers + [self._read] * readers)
        ]

    def __enter__(self) -> "Load":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stopping.set()
        # Who waits for a service that does not come any more goes on, and ends.
        was_up = self._clients.service.up.is_set()
        self._clients.service.up.set()
        for thread in self._threads:
            thread.join()
        if not was_up:
            self._clients.service.up.clear()
        if self._failures and value is None:
            raise self._failures[0]

    def let_write(self, most: float) -> None:
        """Let writers pause once so many writes are acknowledged; at first there is no such bound.

        So faults are spread over a run even where each of them takes a while.
        """
        with self._wrote:
            self._most = most
            self._wrote.notify_all()

    def wait_for(self, acknowledged: int, *, timeout: float = PATIENCE_S) -> None:
        """Return when so many writes have been acknowledged."""
        with self._wrote:
            done = self._wrote.wait_for(
                lambda: self.acknowledged >= acknowledged or bool(self._failures), timeout
            )
        if self._failures:
            raise self._failures[0]
        if not done:
            raise AssertionError(
                f"{self.acknowledged} of {acknowledged} writes were acknowledged in {timeout} s"
            )

    def _run(self, work: Callable[[random.Random], Operation | None], draw: random.Random) -> None:
        try:
            while not self._stopping.is_set():
                self._clients.service.up.wait()
                each = work(draw)
                if each is not None and each.outcome in (NOT_SENT, LOST, 503):
                    self._stopping.wait(PAUSE_S)
        except BaseException as error:  # what ends a thread must end the test
            with self._wrote:
                self._failures.append(error)
                self._wrote.notify_all()

    def _write(self, draw: random.Random) -> Operation | None:
        with self._wrote:
            if not self._wrote.wait_for(lambda: self.acknowledged < self._most, PAUSE_S):
                return None
        subject, people = draw.choice(list(self._subjects.items()))
        if draw.random() < ERASED:
            each = self._clients.erase(subject)
        else:
            each = self._clients.enroll(subject, draw.choice(people))
        if each.answered_well:
            with self._wrote:
                self.acknowledged += 1
                self._wrote.notify_all()
        return each

    def _read(self, draw: random.Random) -> Operation:
        subject, people = draw.choice(list(self._subjects.items()))
        if draw.random() < DESCRIBED:
            return self._clients.describe(subject)
        return self._clients.verify(subject, draw.choice(people))


def look_at_all(clients: Clients, subjects: dict[str, list[int]]) -> None:
    """Describe every subject, and verify each of its people: part of the history like the rest."""
    for subject, people in subjects.items():
        clients.describe(subject)
        for person in people:
            clients.verify(subject, person)
