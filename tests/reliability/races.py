"""Many clients on the same few subjects, over two workers."""

import random
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil

from tests.api.deployment import deploy
from tests.api.server_process import Server
from tests.ports import free_port
from tests.reliability.evidence import Report
from tests.reliability.kill import QUIET
from tests.reliability.load import look_at_all, make_subjects, people_of
from tests.reliability.operations import Clients, Operation, People

CLIENTS = 32
SUBJECTS = 5
KINDS = ("enroll", "enroll", "verify", "verify", "verify", "erase", "describe")


def race_run(database_url: str | None, folder: Path, *, each: int, seed: int) -> Report:
    """Let 32 clients send so many operations each, and look for a serial order."""
    report = Report()
    subjects = make_subjects(SUBJECTS)
    deployment = deploy(folder, database_url=database_url, port=free_port(), **QUIET)
    people = People(deployment, people_of(subjects))
    with Server(deployment, folder) as service:
        clients = Clients(service, people)

        def client(number: int) -> None:
            draw = random.Random(f"{seed} {number}")
            for _ in range(each):
                _something(clients, subjects, draw)

        with _BothWork(service, report.violations):
            _at_once(client, CLIENTS)
        look_at_all(clients, subjects)
        service.kill()
        report.examine(clients, list(subjects), lambda _: False)
    report.figures["operations"] = dict(Counter(each.kind for each in clients.history))
    report.figures["most_at_once_on_one_subject"] = max(
        _most_at_once([each for each in clients.history if each.subject == subject])
        for subject in subjects
    )
    return report


def _something(clients: Clients, subjects: dict[str, list[int]], draw: random.Random) -> None:
    subject, people = draw.choice(list(subjects.items()))
    match draw.choice(KINDS):
        case "enroll":
            clients.enroll(subject, draw.choice(people))
        case "verify":
            clients.verify(subject, draw.choice(people))
        case "erase":
            clients.erase(subject)
        case _:
            clients.describe(subject)


def _at_once(work: Callable[[int], object], count: int) -> None:
    """Run `work` in so many threads that start together; what one of them raises is raised."""
    start = threading.Barrier(count)

    def one(number: int) -> None:
        start.wait()
        work(number)

    with ThreadPoolExecutor(count) as pool:
        for done in [pool.submit(one, number) for number in range(count)]:
            done.result()


class _BothWork:
    """Requires that both workers computed within the block."""

    def __init__(self, service: Server, violations: list[str]) -> None:
        self._workers = [psutil.Process(pid) for pid in service.workers()]
        self._violations = violations

    def __enter__(self) -> None:
        self._before = [self._seconds(each) for each in self._workers]

    def __exit__(self, *_: object) -> None:
        used = [
            self._seconds(each) - before
            for each, before in zip(self._workers, self._before, strict=True)
        ]
        if len(used) != 2 or min(used) < 0.1 * sum(used):
            self._violations.append(f"not both workers had work: CPU seconds {used}")

    @staticmethod
    def _seconds(process: psutil.Process) -> float:
        times = process.cpu_times()
        return float(times.user + times.system)


def _most_at_once(history: Sequence[Operation]) -> int:
    moments = sorted(
        [(each.started, 1) for each in history] + [(each.answered, -1) for each in history]
    )
    most = now = 0
    for _, change in moments:
        now += change
        most = max(most, now)
    return most
