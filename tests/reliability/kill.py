"""SIGKILL of a worker, and of the whole service, at random moments of enrollments and erasures."""

import math
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.api.deployment import deploy
from tests.api.server_process import Server
from tests.ports import free_port
from tests.reliability.evidence import Report
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


def kill_run(
    database_url: str | None,
    folder: Path,
    *,
    operations: int,
    kills: int,
    seed: int,
    progress: Callable[[str], None] = lambda _: None,
) -> Report:
    """Let clients write until so many writes are acknowledged, and kill so often meanwhile.

    Parameters
    ----------
    operations
        Enrollments and erasures to be acknowledged.
    kills
        Spread over them at random; the first is of a worker, the second of the whole service. The
        service is killed once more at the end, so that what is looked at has seen a restart.
    """
    began, draw, report = time.monotonic(), random.Random(seed), Report()
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
        report.examine(clients, list(subjects), _may_end_so)
    report.figures["seconds"] = round(time.monotonic() - began, 1)
    return report


def _kill(
    service: Server,
    clients: Clients,
    report: Report,
    draw: random.Random,
    *,
    of_service: bool,
) -> None:
    workers = service.workers()
    if not of_service and workers:
        os.kill(draw.choice(workers), signal.SIGKILL)
        report.add("kills_of_workers")
        return
    service.kill()
    report.add("kills_of_the_service")
    service.start()
    clients.settle()
    _replay_some(clients, report, draw)


def _replay_some(clients: Clients, report: Report, draw: random.Random) -> None:
    """Send probes again that were decided before the kill, and those that it interrupted."""
    verified = [each for each in list(clients.history) if each.kind == "verify"]
    sent_again = {earlier.request_id for earlier, _ in clients.replays}
    known = [each for each in verified if each.answered_well]
    lost = [each for each in verified if each.outcome == LOST and each.request_id not in sent_again]
    some = draw.sample(known, min(REPLAYED_EACH_TIME // 2, len(known)))
    for earlier in [*known[-REPLAYED_EACH_TIME // 2 :], *some, *lost]:
        clients.replay(earlier)
        report.add("replays")


def _may_end_so(each: Operation) -> bool:
    return each.outcome in (NOT_SENT, LOST)
