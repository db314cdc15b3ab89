"""SQLite without space to write: on a full file system of its own, or at a limit of file sizes."""

import contextlib
import ctypes
import os
import resource
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Protocol

import httpx

from tests.api.deployment import deploy
from tests.api.server_process import Server
from tests.patience import PATIENCE_S
from tests.ports import free_port
from tests.reliability.evidence import Report
from tests.reliability.kill import QUIET
from tests.reliability.load import Load, look_at_all, make_subjects, people_of
from tests.reliability.operations import Clients, Operation, People

MOUNT_BYTES = 4 * 1024 * 1024
FILE_LIMIT_BYTES = 12 * 1024


class Shortage(Protocol):
    """A way to take the database's space away, and to give it back."""

    def take(self, service: Server) -> None: ...

    def give_back(self, service: Server) -> None: ...


class FullFileSystem:
    """Keeps the file system full that the database lies on: ENOSPC.

    What SQLite gives back when it empties its log is taken at once, as by others on a real disk.
    """

    def __init__(self, folder: Path) -> None:
        self._filler = folder / "filler"
        self._held = threading.Event()
        self._keeper: threading.Thread | None = None

    def take(self, service: Server) -> None:
        self._filler.touch()
        self._fill()
        self._held.set()
        self._keeper = threading.Thread(target=self._keep)
        self._keeper.start()

    def give_back(self, service: Server) -> None:
        self._held.clear()
        if self._keeper is not None:
            self._keeper.join()
        self._filler.unlink()

    def _keep(self) -> None:
        while self._held.is_set():
            self._fill()
            time.sleep(0.002)

    def _fill(self) -> None:
        with self._filler.open("r+b", buffering=0) as file:
            file.seek(0, os.SEEK_END)
            for size in (65536, 4096, 1):
                with contextlib.suppress(OSError):
                    while file.write(b"\x00" * size):
                        pass


class FileSizeLimit:
    """Lets no file of the workers grow: EFBIG, for any user, on any file system."""

    def take(self, service: Server) -> None:
        for pid in service.workers():
            _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (FILE_LIMIT_BYTES, hard))

    def give_back(self, service: Server) -> None:
        for pid in service.workers():
            _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))


@contextmanager
def small_file_system() -> Iterator[Path]:
    """Mount a tmpfs of 4 MiB for the block.

    Raises
    ------
    PermissionError
        If this process may not mount.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    folder = Path(tempfile.mkdtemp(prefix="veilface-disk-"))
    options = f"size={MOUNT_BYTES},mode=0700".encode()
    try:
        if libc.mount(b"tmpfs", str(folder).encode(), b"tmpfs", 0, options):
            raise PermissionError(ctypes.get_errno(), "tmpfs cannot be mounted")
        try:
            yield folder
        finally:
            # Lazily: a process that still has a file open keeps it until it closes it.
            libc.umount2(str(folder).encode(), 2)
    finally:
        folder.rmdir()


def full_disk_run(
    shortage: Shortage, database: Path, folder: Path, *, rounds: int, short_s: float, seed: int
) -> Report:
    """Take the space away and give it back, in the middle of enrollments and erasures."""
    report = Report()
    subjects = make_subjects(6)
    deployment = deploy(
        folder,
        database_url=f"sqlite:///{database}",
        port=free_port(),
        **QUIET,
    )
    people = People(deployment, people_of(subjects))
    with Server(deployment, folder) as service:
        clients, workers = Clients(service, people), sorted(service.workers())
        with Load(clients, subjects, writers=4, readers=2, seed=seed) as load:
            for _ in range(rounds):
                load.wait_for(load.acknowledged + 20)
                _round(shortage, clients, short_s, report)
                load.wait_for(load.acknowledged + 20)
        _one_at_a_time(shortage, clients, report)
        if sorted(service.workers()) != workers:
            report.violations.append("workers died: " + service.tail())
        look_at_all(clients, subjects)
        service.kill()
        report.examine(clients, list(subjects), _is_unavailable)
    report.violations += service.defects()
    return report


def _is_unavailable(each: Operation) -> bool:
    return each.outcome == 503 and each.code == "store_unavailable" and each.retry_after == "5"


def _round(shortage: Shortage, clients: Clients, short_s: float, report: Report) -> None:
    service, before = clients.service, len(clients.history)
    shortage.take(service)
    time.sleep(short_s)
    shortage.give_back(service)
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


def _one_at_a_time(shortage: Shortage, clients: Clients, report: Report) -> None:
    """What each call answers without space, with nobody else about."""
    service = clients.service
    subject, person = "subject-0", 1

    def expect(what: str, each: Operation, *, well: bool) -> None:
        if each.answered_well is not well or not (well or _is_unavailable(each)):
            report.violations.append(f"{what}: {each}")

    expect("with space", clients.enroll(subject, person), well=True)
    with _short(shortage, service):
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
def _short(shortage: Shortage, service: Server) -> Iterator[None]:
    shortage.take(service)
    try:
        yield
    finally:
        shortage.give_back(service)


def may_mount() -> bool:
    """Whether this process may mount a file system."""
    attempt: AbstractContextManager[Path] = small_file_system()
    try:
        with attempt:
            return True
    except PermissionError:
        return False
