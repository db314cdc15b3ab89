"""PostgreSQL stopped and started under load; the service stays up."""

import math
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import httpx

from tests.api.deployment import deploy
from tests.api.server_process import Server
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port
from tests.reliability.cluster import Cluster
from tests.reliability.evidence import Report
from tests.reliability.kill import QUIET
from tests.reliability.load import Load, look_at_all, make_subjects, people_of
from tests.reliability.operations import Clients, Operation, People

WRITERS = 5
READERS = 3
KINDS = {"enroll", "erase", "verify", "describe", "contract"}
LEAST_REFUSED = 20
"""Requests that are answered before the database comes back: none waits for it."""


class _Watch:
    """Asks for health all the time."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.seen: list[tuple[float, float, int, int]] = []

    def __enter__(self) -> "_Watch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(0.05):
            before = time.monotonic()
            ready, live = (
                httpx.get(f"{self._url}/health/{name}", timeout=PATIENCE_S).status_code
                for name in ("ready", "live")
            )
            self.seen.append((before, time.monotonic(), ready, live))

    def between(self, begin: float, end: float) -> list[tuple[int, int]]:
        """Return statuses of readiness and liveness, asked and answered between two moments."""
        return [each[2:] for each in list(self.seen) if begin <= each[0] and each[1] <= end]


def outage_run(
    cluster: Cluster, folder: Path, *, modes: Sequence[str], down_s: float, seed: int
) -> Report:
    """Stop the database once in each mode, while clients enroll, erase and verify."""
    report = Report()
    subjects = make_subjects(8)
    deployment = deploy(folder, database_url=cluster.url, port=free_port(), **QUIET)
    people = People(deployment, people_of(subjects))
    with Server(deployment, folder) as service:
        clients, workers = Clients(service, people), sorted(service.workers())
        with (
            Load(clients, subjects, writers=WRITERS, readers=READERS, seed=seed) as load,
            _Watch(service.url) as watch,
        ):
            for mode in modes:
                load.wait_for(load.acknowledged + 40)
                _stop_and_start(cluster, clients, watch, mode, down_s, report)
                load.wait_for(load.acknowledged + 20)
        if sorted(service.workers()) != workers:
            report.violations.append("workers died: " + service.tail())
        clients.settle()
        look_at_all(clients, subjects)
        service.kill()
        report.examine(clients, list(subjects), _is_unavailable)
    return report


def _is_unavailable(each: Operation) -> bool:
    retry_after = each.retry_after or ""
    return (
        each.outcome == 503
        and each.code == "store_unavailable"
        and retry_after.isdecimal()
        and int(retry_after) >= 1
    )


def _stop_and_start(
    cluster: Cluster,
    clients: Clients,
    watch: _Watch,
    mode: str,
    down_s: float,
    report: Report,
) -> None:
    before = len(clients.history)
    cluster.stop(mode)
    stopped = time.monotonic()
    clients.contract()
    time.sleep(down_s)

    def refused() -> list[Operation]:
        sent = [each for each in clients.history[before:] if stopped <= each.started]
        return [each for each in sent if each.answered < math.inf]

    wait_until(
        lambda: len(refused()) >= LEAST_REFUSED and {each.kind for each in refused()} == KINDS,
        what="refusals of every kind while the database is away",
    )
    wait_until(
        lambda: bool(watch.between(stopped, time.monotonic())),
        what="a sign of health while the database is away",
    )
    starting = time.monotonic()
    cluster.start()
    started = time.monotonic()
    recovered = _wait_until_well(clients, watch, started)
    if recovered is None:
        report.violations.append(f"{mode}: not well again")
        recovered = math.nan
    # A request that is still under way is looked at when the run is over.
    asked = [each for each in clients.history[before:] if each.answered < math.inf]
    within = [each for each in asked if stopped <= each.started and each.answered <= starting]
    # Those, too, that were under way when it stopped.
    ended = [each for each in asked if stopped <= each.answered <= starting]
    report.figures[mode] = {
        "requests": len(within),
        "slowest_s": round(max((each.seconds for each in ended), default=0.0), 2),
        "recovered_after_s": round(max(0.0, recovered - started), 2),
    }
    report.violations += [
        f"{mode}: answered well without a database: {each}" for each in within if each.answered_well
    ]
    statuses = set(watch.between(stopped, starting))
    if statuses != {(503, 200)}:
        report.violations.append(f"{mode}: readiness and liveness were {statuses}")


def _wait_until_well(clients: Clients, watch: _Watch, started: float) -> float | None:
    """Return the moment from which on nothing was refused; None if there is none."""
    deadline = started + PATIENCE_S
    while time.monotonic() < deadline:
        time.sleep(0.25)
        now = time.monotonic()
        later = [each for each in list(clients.history) if started <= each.answered <= now]
        refused = [each.answered for each in later if not each.answered_well]
        last = max(refused, default=started)
        newest = watch.between(last, now)[-1:]
        if now - last > 1 and len(later) > 20 and newest == [(200, 200)]:
            return last
    return None
