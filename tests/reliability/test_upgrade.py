"""An upgrade as docs/deploy.md has it: requests go on all the time, and none fails.

The version that comes next is this one, under another path.
"""

import itertools
import os
import re
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

from api.service.opening import open_keyring, open_store
from tests.api.deployment import Deployment, deploy
from tests.api.server_process import ROOT, Server
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port
from tests.reliability.kill import QUIET
from tests.reliability.operations import Clients, Operation, People
from tests.reliability.switch import Switch

PAGE = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8")
PEOPLE = {"ann": 1, "ben": 2, "cas": 3}


@dataclass
class Front:
    """What clients are told: the switch's address, with the deployment behind it."""

    url: str
    deployment: Deployment


@pytest.fixture
def next_version(tmp_path: Path) -> Path:
    """Where the next version is installed: bin/veilface and bin/python."""
    folder = tmp_path / "veilface-next"
    (folder / "bin").mkdir(parents=True)
    for name, program in {"python": "", "veilface": "-P -m veilface"}.items():
        script = folder / "bin" / name
        script.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} {program} "$@"\n')
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


UNIT = (ROOT / "deploy" / "veilface.service").read_text(encoding="utf-8")
SYSTEMCTL = r"""#!/bin/sh
echo "$@" >> {folder}/systemctl.log
unit={folder}/veilface-next.service
case "$1" in
start)
    ports=$(sed -n 's/^Environment=\(VEILFACE_PORT=.*\)/\1/p' $unit)
    env $ports sh -c "exec $(sed -n 's/^ExecStart=//p' $unit)" > {folder}/next.log 2>&1 &
    echo $! > {folder}/next.pid ;;
is-active) grep -Eq '^State:\s+[^Z]' /proc/$(cat {folder}/next.pid)/status ;;
disable) kill -TERM {pid} ;;
esac
"""
NGINX = r"""#!/bin/sh
[ "$1" = -t ] && exit
# In one step: a file that is there is whole.
sed -n 's/.*server 127.0.0.1:\([0-9]*\) .*/\1/p' {folder}/veilface-upstream.conf > {folder}/moved
mv {folder}/moved {folder}/target
"""


@dataclass
class Drill:
    """The page's block, with what is of this machine in the places of what is of another one."""

    folder: Path
    old_port: int
    new_port: int

    def run(self, old: int, environment: dict[str, str]) -> "subprocess.CompletedProcess[str]":
        """Run it as the page says, where the service to replace is a process."""
        stand_ins = self.folder / "stand-ins"
        stand_ins.mkdir()
        for name, text in {"systemctl": SYSTEMCTL, "nginx": NGINX}.items():
            script = stand_ins / name
            script.write_text(text.replace("{folder}", str(self.folder)).replace("{pid}", str(old)))
            script.chmod(0o755)
        (upstream,) = re.findall(r"^upstream veilface \{\n.*?^\}\n", PAGE, flags=re.M | re.S)
        self.upstream.write_text(self._here(upstream))
        (block,) = re.findall(r"^```sh\n(set -e\n.*?)^```\n", PAGE, flags=re.M | re.S)
        return subprocess.run(
            ["sh", "-c", self._here(block)],
            cwd=ROOT,
            env={**os.environ, **environment, "PATH": f"{stand_ins}:{os.environ['PATH']}"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE_S,
        )

    @property
    def upstream(self) -> Path:
        """What nginx is told."""
        return self.folder / "veilface-upstream.conf"

    def asked(self) -> list[str]:
        """What systemctl was asked for, in turn."""
        log = self.folder / "systemctl.log"
        return log.read_text().splitlines() if log.exists() else []

    def _here(self, text: str) -> str:
        names = {
            "/opt/$NEW": f"{self.folder}/$NEW",
            "/etc/systemd/system": str(self.folder),
            "/etc/nginx/conf.d": str(self.folder),
            "10.0.0.11": "127.0.0.1",
            "8421": str(self.old_port),
            "8422": str(self.new_port),
        }
        for there, here in names.items():
            text = text.replace(there, here)
        drained = f"until [ -e {self.folder}/drained ]; do sleep 0.1; done"
        return re.sub(r"^sleep 5\b.*$", drained, text, flags=re.M)


def install(folder: Path, *, ready: str, serve: str) -> None:
    """Programs in the place of the next version's."""
    (folder / "veilface-next" / "bin").mkdir(parents=True)
    for name, line in {"python": ready, "veilface": serve}.items():
        script = folder / "veilface-next" / "bin" / name
        script.write_text(f"#!/bin/sh\n{line}\n")
        script.chmod(0o755)


@pytest.mark.parametrize(
    ("ready", "serve", "asked"),
    [
        # Another service answers on the port that is asked, and the new one could not have it.
        ("exit 0", "exit 1", []),
        # The new service ends before it is ready.
        (
            "exit 1",
            "exit 1",
            ["daemon-reload", "start veilface-next", "is-active --quiet veilface-next"],
        ),
    ],
)
def test_nothing_is_switched_to_a_service_that_does_not_serve(
    tmp_path: Path, ready: str, serve: str, asked: list[str]
) -> None:
    install(tmp_path, ready=ready, serve=serve)
    drill = Drill(tmp_path, old_port=8421, new_port=8422)
    (tmp_path / "drained").touch()
    with subprocess.Popen(["sleep", "600"]) as old:
        try:
            assert drill.run(old.pid, {}).returncode != 0
            assert old.poll() is None
        finally:
            old.kill()
    assert list(dict.fromkeys(drill.asked())) == asked
    assert "127.0.0.1:8421 " in drill.upstream.read_text()
    assert not (tmp_path / "target").exists()


def end(folder: Path) -> None:
    pid = folder / "next.pid"
    if pid.exists() and runs(int(pid.read_text())):
        os.kill(int(pid.read_text()), signal.SIGTERM)
        wait_until(lambda: not runs(int(pid.read_text())))


def runs(pid: int) -> bool:
    """Whether a process is there that has not ended, be it collected or not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.long
def test_no_request_fails_during_an_upgrade(
    next_version: Path, postgres_url: str, tmp_path: Path
) -> None:
    deployment = deploy(tmp_path, database_url=postgres_url, port=free_port(), **QUIET)
    old_port, new_port = deployment.settings.port, free_port()
    drill = Drill(tmp_path, old_port, new_port)
    people = People(deployment, list(PEOPLE.values()))
    with Switch(old_port) as switch, Server(deployment, tmp_path) as old:
        clients = Clients(Front(switch.url, deployment), people)
        assert all(clients.enroll(*each).outcome == 201 for each in PEOPLE.items())
        try:
            with Requests(clients) as requests, told(switch, tmp_path, old_port):
                requests.wait_for_more()
                done = drill.run(old.process.pid, old.environment)
                assert done.returncode == 0, done.stdout
                assert old.process.wait(timeout=PATIENCE_S) == 0, old.tail()
                requests.wait_for_more()
            assert [str(each) for each in requests.failures()] == []
            assert drill.asked()[-2:] == ["enable veilface-next", "disable --now veilface"]
            # The other host's line is as it was.
            servers = re.findall(r"server (\S+) ", drill.upstream.read_text())
            assert servers == [f"127.0.0.1:{new_port}", f"10.0.0.12:{old_port}"]
            unit = (tmp_path / "veilface-next.service").read_text().splitlines()
            new_lines = [line for line in unit if line not in UNIT.splitlines()]
            assert new_lines == [
                f"Environment=VEILFACE_PORT={new_port}",
                f"ExecStart={next_version}/bin/veilface serve --workers 2",
            ]
            store = open_store(deployment.settings, open_keyring(deployment.settings))
            assert store.audit_log.verify().intact
            store.close()
        finally:
            end(tmp_path)
