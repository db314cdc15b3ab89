"""An upgrade as docs/deployment.md has it: requests go on all the time, and none fails.

The version that comes next is this one with one more migration, made here.
"""

import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from api.process.opening import open_keyring, open_store, prepare_database
from templates.store.migrate import current_revision, head_revision
from templates.store.migrations import NEWEST
from tests.api.deployment import Deployment, deploy
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port
from tests.reliability.kill import QUIET
from tests.reliability.operations import Clients, Operation, People
from tests.reliability.service import ROOT, Service
from tests.reliability.switch import Switch

pytestmark = pytest.mark.long

PAGE = (ROOT / "docs" / "deployment.md").read_text(encoding="utf-8")
PACKAGES = ("api", "attacks", "enroll", "models", "templates", "verify")
PEOPLE = {"ann": 1, "ben": 2, "cas": 3}
AFTER = f"{int(NEWEST) + 1:04}_serves_{NEWEST}"
MIGRATION = f'''
"""What an earlier version need not know of: a table, an index, columns that may be empty."""

import sqlalchemy as sa
from alembic import op

revision = "{AFTER}"
down_revision = "{head_revision()}"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table("more", sa.Column("id", sa.Integer(), primary_key=True))
    op.execute("SELECT pg_sleep(1)")
    op.create_index("ix_subjects_updated_at", "subjects", ["updated_at"])
    for table in ("subjects", "templates", "api_keys", "audit_log", "audit_head"):
        op.add_column(table, sa.Column("more", sa.String(length=16), nullable=True))


def downgrade() -> None:
    """Take back."""
'''


@dataclass
class Front:
    """What clients are told: the switch's address, with the deployment behind it."""

    url: str
    deployment: Deployment


@pytest.fixture
def next_version(tmp_path: Path) -> Path:
    """Where the next version is installed: bin/veilface and bin/python."""
    folder = tmp_path / "next"
    for package in PACKAGES:
        # With the compiled kernels, which take long to make.
        shutil.copytree(ROOT / package, folder / package)
    migrations = folder / "templates" / "store" / "migrations" / "versions"
    (migrations / f"{AFTER[:4]}_more.py").write_text(MIGRATION)
    (folder / "bin").mkdir()
    for name, program in {"python": "", "veilface": "-m api.cli"}.items():
        script = folder / "bin" / name
        script.write_text(f'#!/bin/sh\ncd {folder} && exec {sys.executable} {program} "$@"\n')
        script.chmod(0o755)
    return folder


class Requests:
    """Threads that enroll and verify the same people, from the start of the block to its end."""

    def __init__(self, clients: Clients) -> None:
        self.clients = clients
        self._stopping = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, args=(work,))
            for work in (clients.verify, clients.verify, clients.enroll)
        ]

    def __enter__(self) -> "Requests":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join()

    def wait_for_more(self) -> None:
        """Return when ten more of each kind were answered."""
        before = self._answered()
        wait_until(
            lambda: all(
                now >= then + 10 for now, then in zip(self._answered(), before, strict=True)
            )
        )

    def failures(self) -> list[Operation]:
        """Requests that did not do what they would have done on a quiet day."""
        return [
            each
            for each in self.clients.history
            if not each.answered_well or (each.kind == "verify" and not each.accepted)
        ]

    def _answered(self) -> tuple[int, int]:
        kinds = [each.kind for each in list(self.clients.history) if each.answered_well]
        return kinds.count("verify"), kinds.count("enroll")

    def _run(self, work: Callable[[str, int], Operation]) -> None:
        for subject, person in itertools.cycle(PEOPLE.items()):
            if self._stopping.is_set():
                return
            work(subject, person)


@contextmanager
def told(switch: Switch, folder: Path, old: int) -> Iterator[None]:
    """Let a file tell the switch where to lead, and another one that nothing leads back."""
    done = threading.Event()

    def watch() -> None:
        while not done.wait(0.05):
            if (folder / "target").exists():
                switch.target = int((folder / "target").read_text())
            if switch.has_left(old):
                (folder / "drained").touch()

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def drill(new_version: Path, old: Service, port: int, folder: Path) -> str:
    """The page's block, with what is of this machine in the places of what is of another one."""
    (block,) = re.findall(r"^```sh\n(NEXT=.*?)^```\n", PAGE, flags=re.M | re.S)
    first, rest = block.split("\n", 1)
    assert first.startswith("NEXT=/opt/veilface-next OLD=$(systemctl show")
    # In one step: a file that is there is whole.
    moved = f"echo {port} > {folder}/moved\nmv {folder}/moved {folder}/target"
    names = {
        r"8422": str(port),
        r"serve &$": f"serve >{folder}/next.log 2>&1 & echo $! > {folder}/next.pid",
        r"^sed .*nginx -s reload$": moved,
        r"^sleep 5\b.*$": f"until [ -e {folder}/drained ]; do sleep 0.1; done",
    }
    for ours, theirs in names.items():
        rest, count = re.subn(ours, theirs, rest, flags=re.M)
        assert count, ours
    return f"NEXT={new_version} OLD={old.process.pid}\n{rest}"


def end(folder: Path) -> None:
    pid = folder / "next.pid"
    if pid.exists() and psutil.pid_exists(int(pid.read_text())):
        os.kill(int(pid.read_text()), signal.SIGTERM)
        wait_until(lambda: not psutil.pid_exists(int(pid.read_text())))


def test_no_request_fails_during_an_upgrade(
    next_version: Path, postgres_url: str, tmp_path: Path
) -> None:
    deployment = deploy(tmp_path, database_url=postgres_url, port=free_port(), **QUIET)
    old_port, new_port = deployment.settings.port, free_port()
    people = People(deployment, list(PEOPLE.values()))
    with Switch(old_port) as switch, Service(deployment, tmp_path) as old:
        clients = Clients(Front(switch.url, deployment), people)
        assert all(clients.enroll(*each).outcome == 201 for each in PEOPLE.items())
        try:
            with Requests(clients) as requests, told(switch, tmp_path, old_port):
                requests.wait_for_more()
                done = subprocess.run(
                    [
                        "bash",
                        "-euo",
                        "pipefail",
                        "-c",
                        drill(next_version, old, new_port, tmp_path),
                    ],
                    env={**os.environ, **old.environment()},
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                    timeout=PATIENCE_S,
                )
                assert done.returncode == 0, done.stdout
                assert old.process.wait(timeout=PATIENCE_S) == 0, old.tail()
                requests.wait_for_more()
            assert [str(each) for each in requests.failures()] == []
            store = open_store(deployment.settings, open_keyring(deployment.settings))
            assert current_revision(store.database) == AFTER
            # What a start of the earlier version does: it may go back, should the new one not do.
            prepare_database(store)
            assert store.audit_log.verify().intact
            store.close()
        finally:
            end(tmp_path)
