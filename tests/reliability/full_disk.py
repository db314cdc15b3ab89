"""SQLite without space to write: at a limit of file sizes, which answers as a full disk does."""

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from tests.api.deployment import deploy
from tests.api.server_process import Server
from tests.patience import PATIENCE_S
from tests.ports import free_port
from tests.reliability.evidence import Report
from tests.reliability.kill import QUIET
from tests.reliability.load import Load, look_at_all, make_subjects, people_of
from tests.reliability.operations import Clients, Operation, People

FILE_LIMIT_BYTES = 12 * 1024


def _take_space(service: Server) -> None:
    """Let no file of the workers grow: EFBIG, for any user, on any file system."""
    _limit_files(service, FILE_LIMIT_BYTES)


def _give_space_back(service: Server) -> None:
    _limit_files(service, None)


def _limit_files(service: Server, most: int | None) -> None:
    for pid in service.workers():
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard if most is None else most, hard))


def full_disk_run(folder: Path, *, rounds: int, short_s: float, seed: int) -> Report:
    """Take the space away and give it back, in the middle of enrollments and erasures."""
    report = Report()
    subjects = make_subjects(6)
    deployment = deploy(
        folder,
        port=free_port(),
        **QUIET,
    )
    people = People(deployment, people_of(subjects))
    with Server(deployment, folder) as service:
        clients, workers = Clients(service, people), sorted(service.workers())
        with Load(clients, subjects, writers=4, readers=2, seed=seed) as load:
            for _ in range(rounds):
                load.wait_for(load.acknowledged + 20)
                _round(clients, short_s, report)
                load.wait_for(load.acknowledged + 20)
        _one_at_a_time(clients, report)
        if sorted(service.workers()) != workers:
            report.violations.append("workers died: " + service.tail())
        look_at_all(clients, subjects)
        service.kill()
        report.examine(clients, list(subjects), _is_unavailable)
    report.violations += service.defects()
    return report


def _is_unavailable(each: Operation) -> bool:
    return each.outcome == 503 and each.code == "store_unavailable" and each.retry_after == "5"


def _round(clients: Clients, short_s: float, report: Report) -> None:
    service, before = clients.service, len(clients.history)
    _take_space(service)
    time.sleep(short_s)
    _give_space_back(service)
    freed = time.monotonic()
    refused = [each for each in clients.history[before:] if each.outcome == 503]
    if not refused:
        report.violations.append("no request was refused without space")
    _await_ready(service, freed, report)


def _await_ready(service: Server, freed: float, report: Report) -> None:
    """Every worker must get ready by itself; a fresh connection asks either of them."""
    in_a_row = 0
    while in_a_row < 10:
        if time.monotonic() > freed + PATIENCE_S:
            report.violations.append("not ready after space was freed")
            return
        in_a_row = in_a_row + 1 if service.is_ready() else 0
    recovered = report.figures.setdefault("recovered_after_s", [])
    recovered.append(round(time.monotonic() - freed, 2))


def _one_at_a_time(clients: Clients, report: Report) -> None:
    """What each call answers without space, with nobody else about."""
    service = clients.service
    subject, person = "subject-0", 1

    def expect(what: str, each: Operation, *, well: bool) -> None:
        if each.answered_well is not well or not (well or _is_unavailable(each)):
            report.violations.append(f"{what}: {each}")

    expect("with space", clients.enroll(subject, person), well=True)
    with _short(service):
        # The first may find room in pages and in a log that are there already.
        writes = [clients.enroll("subject-1", 4) for _ in range(40)]
        if not _is_unavailable(writes[-1]):
            report.violations.append("40 enrollments were written without space")
        for _ in range(4):
            expect("erase without space", clients.erase(subject), well=False)
            # A decision is not let out unrecorded.
            expect("verify without space", clients.verify(subject, person), well=False)
            expect("describe without space", clients.describe(subject), well=True)
            expect("contract without space", clients.contract(), well=True)
        if httpx.get(f"{service.url}/health/live", timeout=PATIENCE_S).status_code != 200:
            report.violations.append("not live without space")
        for _ in range(10):
            if service.is_ready():
                report.violations.append("ready without space")
    freed = time.monotonic()
    expect("verify with space", clients.verify(subject, person), well=True)
    expect("erase with space", clients.erase(subject), well=True)
    _await_ready(service, freed, report)


@contextmanager
def _short(service: Server) -> Iterator[None]:
    _take_space(service)
    try:
        yield
    finally:
        _give_space_back(service)
