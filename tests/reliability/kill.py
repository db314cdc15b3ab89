"""SIGKILL of a worker, and of the whole service, at random moments of enrollments and erasures."""

import math
import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tests.api.deployment import deploy
from tests.api.server_process import Server
from tests.ports import free_port
from tests.reliability.evidence import examine, unexpected
from tests.reliability.load import Load, look_at_all, make_subjects, people_of
from tests.reliability.operations import LOST, NOT_SENT, Clients, Operation, People

WORKERS = 2
WRITERS = 5
READERS = 3
OF_THE_SERVICE = 0.4
REPLAYED_EACH_TIME = 8
AHEAD = 12
"""Writes after which the writers wait for a kill that is due, so that kills come all along."""
QUIET: dict[str, Any] = {
    "workers": WORKERS,
    "compute_slots": 1,
    "rate_limit_key": "off",
    "rate_limit_address": "off",
    "lockout_after": 0,
    "queue_limit": 256,
}
"""Settings at which nothing but the faults of a scenario refuses."""


@dataclass
class KillReport:
    """Figures of a run; `violations` is empty where all holds."""

    database: str
    seed: int
    acknowledged_enrollments: int = 0
    acknowledged_erasures: int = 0
    unacknowledged_writes: int = 0
    of_these_effective: int = 0
    acknowledged_decisions: int = 0
    unacknowledged_decisions: int = 0
    kills_of_workers: int = 0
    kills_of_the_service: int = 0
    restarts: int = 0
    replays: int = 0
    answers_503: int = 0
    audit_lines: int = 0
    seconds: float = 0.0
    violations: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def kill_run(
    database: str,
    database_url: str | None,
    folder: Path,
    *,
    operations: int,
    kills: int,
    seed: int,
    progress: Callable[[str], None] = lambda _: None,
) -> KillReport:
    """Let clients write until so many writes are acknowledged, and kill so often meanwhile.

    Parameters
    ----------
    database
        What the report calls it.
    operations
        Enrollments and erasures to be acknowledged.
    kills
        Spread over them at random; the first is of a worker, the second of the whole service. The
        service is killed once more at the end, so that what is looked at has seen a restart.
    """
    began, draw = time.monotonic(), random.Random(seed)
    report = KillReport(database, seed)
    subjects = make_subjects(8)
    deployment = deploy(folder, database_url=database_url, port=free_port(), **QUIET)
    people = People(deployment, people_of(subjects))
    moments = sorted(draw.sample(range(2, operations - 1), kills))
    with Server(deployment, folder) as service:
        clients = Clients(service, people)
        with Load(clients, subjects, writers=WRITERS, readers=READERS, seed=seed) as load:
            for number, moment in enumerate(moments):
                load.let_write(moment + AHEAD)
                load.wait_for(moment)
                # Somewhere in the requests that run now, not just after an answer.
                time.sleep(draw.uniform(0, 0.05))
                of_service = number == 1 or (number > 1 and draw.random() < OF_THE_SERVICE)
                _kill(service, clients, report, draw, of_service=of_service)
                progress(f"{load.acknowledged} writes, {number + 1} kills")
            load.let_write(math.inf)
            load.wait_for(operations)
        _kill(service, clients, report, draw, of_service=True)
        look_at_all(clients, subjects)
        service.kill()
        report.restarts = service.starts - 1
        _examine(clients, list(subjects), report)
    report.seconds = round(time.monotonic() - began, 1)
    return report


def _kill(
    service: Server,
    clients: Clients,
    report: KillReport,
    draw: random.Random,
    *,
    of_service: bool,
) -> None:
    workers = service.workers()
    if not of_service and workers:
        os.kill(draw.choice(workers), signal.SIGKILL)
        report.kills_of_workers += 1
        return
    service.kill()
    report.kills_of_the_service += 1
    service.start()
    clients.settle()
    _replay_some(clients, report, draw)


def _replay_some(clients: Clients, report: KillReport, draw: random.Random) -> None:
    """Send probes again that were decided before the kill, and those that it interrupted."""
    verified = [each for each in list(clients.history) if each.kind == "verify"]
    sent_again = {earlier.request_id for earlier, _ in clients.replays}
    known = [each for each in verified if each.answered_well]
    lost = [each for each in verified if each.outcome == LOST and each.request_id not in sent_again]
    some = draw.sample(known, min(REPLAYED_EACH_TIME // 2, len(known)))
    for earlier in [*known[-REPLAYED_EACH_TIME // 2 :], *some, *lost]:
        clients.replay(earlier)
        report.replays += 1


def _may_end_so(each: Operation) -> bool:
    return each.outcome in (NOT_SENT, LOST)


def _examine(clients: Clients, subjects: list[str], report: KillReport) -> None:
    examined = examine(clients, subjects)
    history = clients.history
    report.violations = [*unexpected(history, _may_end_so), *examined.violations]
    report.of_these_effective, report.audit_lines = examined.effective, examined.lines
    for each in history:
        report.answers_503 += each.outcome == 503
        report.acknowledged_enrollments += each.kind == "enroll" and each.answered_well
        report.acknowledged_erasures += each.kind == "erase" and each.answered_well
        report.acknowledged_decisions += each.kind == "verify" and each.answered_well
        report.unacknowledged_writes += each.writes and each.may_have_happened
        report.unacknowledged_decisions += each.kind == "verify" and each.may_have_happened
